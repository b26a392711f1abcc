"""The optimisers of the fits: Adam in the eigenbasis of Shampoo's preconditioner for the fast one, and Adam."""

from __future__ import annotations

import torch


class Soap:
    """SOAP (Vyas et al., "SOAP: Improving and Stabilizing Shampoo using Adam", 2024) for stacks of small matrices.

    For each matrix gradient G it tracks averages of G G^T and G^T G, and runs Adam in the basis of their
    eigenvectors, which one step of orthogonal iteration follows every few updates. On these 64-wide networks that
    costs a tenth of the gradient itself, and reaches in a thousand steps what Adam does not in ten thousand.

    Args:
        parameters: each [stack, rows, columns]; a dimension of size 1 is not rotated.
        lr: step size; `step` takes a factor on it.
    """

    MOMENTUM, SECOND, PRECONDITIONER = 0.95, 0.95, 0.95
    REFRESH = 10

    def __init__(self, parameters: list[torch.Tensor], lr: float) -> None:
        self.parameters = parameters
        self.lr = lr
        self.count = 0
        self.state: list[dict[str, torch.Tensor]] = []
        for parameter in parameters:
            state = {"mean": torch.zeros_like(parameter), "square": torch.zeros_like(parameter)}
            for side, size in (("left", parameter.shape[1]), ("right", parameter.shape[2])):
                if size > 1:
                    eye = torch.eye(size, dtype=parameter.dtype, device=parameter.device)
                    state[f"{side}_average"] = torch.zeros_like(eye).repeat(len(parameter), 1, 1)
                    state[f"{side}_basis"] = eye.repeat(len(parameter), 1, 1)
            self.state.append(state)

    @torch.no_grad()
    def step(self, factor: float) -> None:
        """Apply the gradients in `parameter.grad`; the first call only sets up the bases.

        Args:
            factor: of the learning-rate schedule.
        """
        self.count += 1
        for parameter, state in zip(self.parameters, self.state, strict=True):
            gradient = parameter.grad
            if gradient is None:
                continue
            if self.count > 1:
                state["mean"].lerp_(gradient, 1 - self.MOMENTUM)
                rotated = _rotate(gradient, state)
                state["square"].mul_(self.SECOND).addcmul_(rotated, rotated, value=1 - self.SECOND)
                updates = self.count - 1
                mean = _rotate(state["mean"], state) / (1 - self.MOMENTUM**updates)
                square = state["square"] / (1 - self.SECOND**updates)
                parameter -= self.lr * factor * _rotate_back(mean / (square.sqrt() + 1e-10), state)
            for side, product in (("left", gradient @ gradient.mT), ("right", gradient.mT @ gradient)):
                average = state.get(f"{side}_average")
                if average is None:
                    continue
                if self.count == 1:
                    average.copy_(product)
                    scale = product.diagonal(dim1=1, dim2=2).amax(-1).clamp_min(1e-30)[:, None, None]
                    ridge = 1e-6 * torch.eye(product.shape[1], dtype=product.dtype, device=product.device)
                    state[f"{side}_basis"] = torch.linalg.eigh(product / scale + ridge)[1].flip(2)
                else:
                    average.lerp_(product, 1 - self.PRECONDITIONER)
                    if self.count % self.REFRESH == 0:
                        state[f"{side}_basis"] = torch.linalg.qr(average @ state[f"{side}_basis"])[0]

    def tensors(self) -> dict[str, torch.Tensor]:
        """Everything that the next step depends on, beside the parameters."""
        kept = {f"{i}.{key}": value for i, state in enumerate(self.state) for key, value in state.items()}
        return {**kept, "count": torch.tensor(self.count), "lr": torch.tensor(self.lr, dtype=torch.float64)}

    def restore(self, tensors: dict[str, torch.Tensor]) -> None:
        """Go on from what `tensors` gave."""
        for i, state in enumerate(self.state):
            for key in state:
                state[key] = tensors[f"{i}.{key}"]
        self.count, self.lr = int(tensors["count"]), float(tensors["lr"])


class Adam:
    """torch's Adam at a constant rate, in the shape of `Soap`.

    Args:
        parameters: what it updates.
        lr: step size.
    """

    def __init__(self, parameters: list[torch.Tensor], lr: float) -> None:
        self.lr = lr
        self._adam = torch.optim.Adam(parameters, lr=lr)

    def step(self, factor: float) -> None:
        """Apply the gradients; the paper's recipe has no schedule, so `factor` does not count."""
        self._adam.step()

    def tensors(self) -> dict[str, torch.Tensor]:
        """As `Soap.tensors`."""
        state = self._adam.state_dict()["state"]
        kept = {f"{i}.{key}": value for i, entry in state.items() for key, value in entry.items()}
        return {**kept, "lr": torch.tensor(self.lr, dtype=torch.float64)}

    def restore(self, tensors: dict[str, torch.Tensor]) -> None:
        """As `Soap.restore`."""
        state: dict[int, dict[str, torch.Tensor]] = {}
        for name, value in tensors.items():
            if name != "lr":
                number, key = name.split(".")
                state.setdefault(int(number), {})[key] = value
        self.lr = float(tensors["lr"])
        groups = [{**group, "lr": self.lr} for group in self._adam.state_dict()["param_groups"]]
        self._adam.load_state_dict({"state": state, "param_groups": groups})


def _rotate(matrix: torch.Tensor, state: dict[str, torch.Tensor]) -> torch.Tensor:
    if "left_basis" in state:
        matrix = state["left_basis"].mT @ matrix
    return matrix @ state["right_basis"] if "right_basis" in state else matrix


def _rotate_back(matrix: torch.Tensor, state: dict[str, torch.Tensor]) -> torch.Tensor:
    if "left_basis" in state:
        matrix = state["left_basis"] @ matrix
    return matrix @ state["right_basis"].mT if "right_basis" in state else matrix
