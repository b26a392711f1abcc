"""SOAP, the optimiser that fits SDF networks."""

import torch


class Soap:
    """SOAP (Vyas et al., "SOAP: Improving and Stabilizing Shampoo using Adam", 2024) on a small network.

    For each matrix gradient G of `parameters`, each [L, rows, columns] for L equal layers, it tracks averages of G G^T
    and G^T G, and runs Adam in the basis of their eigenvectors. One step of orthogonal iteration updates this basis
    every few steps. The first step only sets up the bases. A dimension of size 1 is not rotated.
    """

    MOMENTUM, SECOND, LEAST = 0.95, 0.95, 1e-10
    PRECONDITIONER = 0.95
    REFRESH = 10

    def __init__(self, parameters: list[torch.Tensor], lr: float) -> None:
        self.parameters = parameters
        self.lr = lr
        self.count = 0
        self.state = [self._begin(parameter) for parameter in parameters]

    def _begin(self, parameter: torch.Tensor) -> dict[str, torch.Tensor]:
        state = {"mean": torch.zeros_like(parameter), "square": torch.zeros_like(parameter)}
        for side, size in (("left", parameter.shape[-2]), ("right", parameter.shape[-1])):
            if size > 1:
                eye = torch.eye(size, dtype=parameter.dtype, device=parameter.device)
                state[f"{side}_average"] = torch.zeros_like(eye).repeat(len(parameter), 1, 1)
                state[f"{side}_basis"] = eye.repeat(len(parameter), 1, 1)
        return state

    @torch.no_grad()
    def step(self, factor: float) -> None:
        """Apply the gradients; `factor` multiplies the learning rate (its schedule)."""
        self.count += 1
        for parameter, state in zip(self.parameters, self.state, strict=True):
            gradient = parameter.grad
            assert gradient is not None
            if self.count > 1:
                parameter -= self.lr * factor * self._direction(gradient, state)
            self._follow(gradient, state)

    def _direction(self, gradient: torch.Tensor, state: dict[str, torch.Tensor]) -> torch.Tensor:
        """Adam's update in the rotated basis, turned back."""
        state["mean"].lerp_(gradient, 1 - self.MOMENTUM)
        mean, rotated = _rotate(state["mean"], state), _rotate(gradient, state)
        state["square"].mul_(self.SECOND).addcmul_(rotated, rotated, value=1 - self.SECOND)
        updates = self.count - 1
        mean = mean / (1 - self.MOMENTUM**updates)
        root = (state["square"] / (1 - self.SECOND**updates)).sqrt_().add_(self.LEAST)
        direction = mean.div_(root)
        if "left_basis" in state:
            direction = state["left_basis"] @ direction
        return direction @ state["right_basis"].mT if "right_basis" in state else direction

    def _follow(self, gradient: torch.Tensor, state: dict[str, torch.Tensor]) -> None:
        """Update the averages of G G^T and G^T G, and every few steps their eigenvectors."""
        for side, product in (("left", gradient @ gradient.mT), ("right", gradient.mT @ gradient)):
            average = state.get(f"{side}_average")
            if average is None:
                continue
            if self.count == 1:
                average.copy_(product)
                scale = product.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-30)[..., None, None]
                ridge = 1e-6 * torch.eye(product.shape[-1], dtype=product.dtype, device=product.device)
                state[f"{side}_basis"] = torch.linalg.eigh(product / scale + ridge)[1].flip(-1)
            else:
                average.lerp_(product, 1 - self.PRECONDITIONER)
                if self.count % self.REFRESH == 0:
                    state[f"{side}_basis"] = torch.linalg.qr(average @ state[f"{side}_basis"])[0]


def _rotate(matrix: torch.Tensor, state: dict[str, torch.Tensor]) -> torch.Tensor:
    if "left_basis" in state:
        matrix = state["left_basis"].mT @ matrix
    return matrix @ state["right_basis"] if "right_basis" in state else matrix
