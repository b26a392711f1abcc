"""Moves the vertices of bodies to where photos agree best; the accuracy of the field's own surface is limited by its
cells.

Around a vertex lies a patch in the tangent plane. On the true surface, this patch looks the same in all photos that
show it; so the patch is moved along the normal until it does (normalised cross-correlation). At edges patches give no
information: there the surface is the smallest one between known places on both sides, which removes bulges.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import cg

from pipeline.cameras import View, frame_of
from pipeline.inputs.photos import open_photo
from pipeline.mesh.visibility import FAIR, Visibility
from sdfsim.base.parallel import threads
from sdfsim.geometry.bvh import Caster
from sdfsim.geometry.mesh import Mesh, vertex_normals

# Set by hand on `shelf` (a torus, a box and a jug) and the table with a vase, except where a comment says otherwise.
LONG_SIDE = 640  # px; larger photos are reduced, because otherwise the right place would lie too many pixels away
# Photos in which a patch is compared, those with the best viewing angle; and how many have to agree: any two do.
# Of a drawn ball with an obstacle before three cameras, six photos are better than five and as good as eight.
PHOTOS, FEWEST = 6, 3
PATCH = np.indices((7, 7)).reshape(2, -1).T.astype(np.float32) - 3  # [G, 2] px from a patch's middle
NOISE = 4.0  # grey levels squared: variance that is no texture
PLACES = 15  # tried along the normal
# Largest move of vertices per round, in cells of the field's finest grid, and rounds; half as far in the last.
REACH, ROUNDS = 1.3, 3
BATCH = 400  # vertices compared at once; their patches take 10 MB
EVERY = 4  # one vertex of so many is compared, the others follow
ALIKE, SURE = 0.35, 0.9  # correlations between which the trust in a place rises from 0 to 1
# A place is not trusted beyond SPREAD times the usual difference from the surface around it. The places around define
# the usual difference, because many of them are far off if the field is; but it is at most FAR times the body's median.
SPREAD, FAR = 3.0, 2.0
# A place has full weight if the mean trust within NEAR edges is EVEN: a single match at an edge is a mistake.
NEAR, EVEN = 8, 0.3
# Weights relative to trust: of the surface's bending, of a vertex's old position, and of that where no
# photo shows the surface.
BENDING, STAY, PINNED = 0.3, 0.002, 0.5
AROUND, KNOWN = 20, 0.1 / EVERY  # edges, and mean trust within them, below which vertices stay
SMOOTHED, SMOOTHING = 4, (0.5, -0.53)  # times after each round, and how far towards the mean of the neighbours
# Lengths of the mean normal within `NEAR` edges, from a rim to a surface that is flat there.
RIM, FLAT = 0.6, 0.9
STEPS = 300  # of conjugate gradients; after these the equations count as not solved (not tuned)
WALL = 0.25  # of the distance to the opposite surface, inside or outside, that a vertex may move in a round


@dataclass(frozen=True)
class GreyPhoto:
    """A photo to compare patches in."""

    view: View  # its camera, for the pixels of the file
    scale: float  # of the pixels of `grey` to those
    grey: np.ndarray  # [H, W] float32

    def levels(self, middles: np.ndarray, sides: np.ndarray) -> np.ndarray:
        """Its grey levels [S, M, G] float32, with mean 0 and length 1, at patches with steps `sides` [S, 2, 3] around
        middles [S, M, 3]; so small patches are affine in the photo."""
        import cv2

        ends = np.stack([middles, middles + sides[:, None, 0], middles + sides[:, None, 1]])
        pixels = self.scale * self.view.project(ends.reshape(-1, 3))[0]
        at, right, down = pixels.reshape(3, -1, 1, 2).astype(np.float32)
        pixels = at - np.float32(0.5) + PATCH[:, :1] * (right - at) + PATCH[:, 1:] * (down - at)
        grey = cv2.remap(self.grey, pixels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        grey -= grey.mean(1, keepdims=True)
        grey /= np.sqrt((grey**2).sum(1, keepdims=True) + NOISE * len(PATCH))
        return grey.reshape(*middles.shape[:2], len(PATCH))


def load_grey_photos(views: Sequence[View], photos_folder: Path) -> list[GreyPhoto]:
    """The photos of some views, grey and no larger than `LONG_SIDE`."""
    import cv2

    found = []
    for view in views:
        grey = np.asarray(open_photo(photos_folder, view, "L"), np.float32)
        scale = min(1.0, LONG_SIDE / max(grey.shape))
        size = round(view.width * scale), round(view.height * scale)
        found.append(GreyPhoto(view, scale, cv2.resize(grey, size, interpolation=cv2.INTER_AREA)))
    return found


def refine(mesh: Mesh, pictures: list[GreyPhoto], blocking: Caster, lift: float, finest: float,
           height: Callable[[np.ndarray], np.ndarray], layer: float) -> tuple[Mesh, str]:  # fmt: skip
    """A body with vertices where the photos agree, and the reason if not all rounds were done; all is in the space of
    the views.

    Vertices are lifted by `lift` off the surface before a view looks for them, and move by cells of width `finest`.
    Below `layer` of `height`, above the plane that the body stands on, no photo separates the body from its plane, so
    vertices there move along the plane only.
    """
    count = len(mesh.vertices)
    if len(pictures) < FEWEST:
        return mesh, f"there are only {len(pictures)} photos, it takes {FEWEST}"
    if count < EVERY:
        return mesh, f"it has only {count} vertices, it takes {EVERY}"
    mean = mean_of_neighbours(mesh)
    low = height(mesh.vertices) < layer
    upright = height(np.eye(3)) - height(np.zeros((1, 3))) if low.any() else np.zeros(3)
    for number in range(ROUNDS):
        common, normal = vertex_normals(mesh), smooth_normals(mesh, mean)
        for _ in range(NEAR):
            common = mean @ common
        # Around a rim normals differ. A patch there shows what lies behind, and no photo agrees on a place.
        flat = ((np.linalg.norm(common, axis=1) - RIM) / (FLAT - RIM)).clip(0, 1)
        picked = np.random.default_rng(number).permutation(count)[: count // EVERY]
        moves = np.linspace(-1, 1, PLACES) * REACH * finest / (1 if number + 1 < ROUNDS else 2)
        score = patch_correlation(Visibility(mesh, lift, blocking).at(picked), normal[picked], pictures, moves)
        place, trust = best_places(score, moves)
        trust[low[picked]] = 0
        if not trust.any():
            return mesh, f"nowhere do {FEWEST} photos show it and agree"
        along = np.where(low[:, None], normal - (normal @ upright)[:, None] * upright, normal)
        wanted, weight = np.zeros(count), np.zeros(count)
        wanted[picked], weight[picked] = place, trust
        near = weight
        for _ in range(NEAR):
            near = mean @ near
        weight = weight * (near / (EVEN / EVERY)).clip(0, 1) * flat
        known = np.stack([weight, ~low], 1)
        for _ in range(AROUND):
            known = mean @ known
        known = (known[:, 0] / (KNOWN * known[:, 1]).clip(1e-6)).clip(0, 1)
        stay = STAY + PINNED * (1 - known * flat)
        moved, converged = settled(mesh, along, mean, wanted, weight, stay)
        # A place that contradicts the surface around it was a mistake.
        off = np.abs(moved - wanted)
        around = np.stack([weight * off, weight], 1)
        for _ in range(NEAR):
            around = mean @ around
        most = FAR * np.median(off[weight > 0]) if (weight > 0).any() else 1.0
        usual = (around[:, 0] / around[:, 1].clip(1e-9)).clip(None, most)
        weight = weight * np.exp(-((off / (SPREAD * usual + 1e-9)) ** 2))
        moved, again = settled(mesh, along, mean, wanted, weight, stay)
        if not (converged and again):
            return mesh, f"its equations were not solved in {STEPS} steps, in round {number + 1} of {ROUNDS}"
        moved = moved.clip(moves[0], moves[-1])
        # The two sides of a thin wall must not pass through each other.
        caster, skin = Caster(mesh), 1e-3 * finest * normal
        inwards, outwards = (caster.hits(mesh.vertices + way * skin, way * normal)[0] for way in (-1, 1))
        moved = moved.clip(-WALL * inwards, WALL * outwards)
        vertices = mesh.vertices + moved[:, None] * along
        # There and back, because steps in one direction alone shrink rims and the tips of leaves (Taubin, 1995).
        for share in SMOOTHING * SMOOTHED:
            vertices = vertices + share * (known * ~low)[:, None] * (mean @ vertices - vertices)
        mesh = replace(mesh, vertices=vertices)
    return mesh, ""


def mean_of_neighbours(mesh: Mesh) -> csr_matrix:
    """The matrix [V, V] that takes the mean over the neighbours of each vertex."""
    count = len(mesh.vertices)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    links = coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count)).tocsr()
    links = ((links + links.T) > 0).astype(float)
    return (diags(1 / np.asarray(links.sum(1)).ravel()) @ links).tocsr()


def smooth_normals(mesh: Mesh, mean: csr_matrix) -> np.ndarray:
    """Unit normals [V, 3] of vertices without the noise of the finest triangles."""
    normal = vertex_normals(mesh)
    for _ in range(4):
        normal = normal + mean @ normal
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return normal


def patch_correlation(
    sight: Visibility, normal: np.ndarray, pictures: list[GreyPhoto], moves: np.ndarray
) -> np.ndarray:
    """Similarity of the patches [P, M] around vertices [P], moved [M] along normals [P, 3], between the photos with the
    best viewing angle: the mean correlation of one of them with the two that agree best with it, -1 if fewer than
    `FEWEST` photos show a vertex. So photos before which something stands that is not reconstructed do no harm."""
    cosine = np.zeros((len(pictures), len(normal)), np.float32)
    for number, picture in enumerate(pictures):
        index, _, straight = sight.of_view(picture.view)
        cosine[number, index] = np.where(straight > FAIR, straight, 0)
    chosen = np.argsort(-cosine, 0)[:PHOTOS]
    shown = np.take_along_axis(cosine, chosen, 0) > 0
    centers = np.array([picture.view.center for picture in pictures])[chosen[0]]
    pixel = np.array([1 / (picture.view.focal * picture.scale) for picture in pictures])[chosen[0]]
    pixel = pixel * np.linalg.norm(centers - sight.vertices, axis=1)
    sides = pixel[:, None, None] * frame_of(normal)[:, :2]
    result = np.full((len(normal), len(moves)), -1.0)

    def compare(part: np.ndarray) -> None:
        number = np.where(shown[:, part], chosen[:, part], -1)
        middles = sight.vertices[part, None] + moves[:, None] * normal[part, None]  # [S, M, 3]
        found = np.zeros((len(part), len(moves), len(number), len(PATCH)), np.float32)
        for k in np.unique(number[number >= 0]):
            slot, which = np.nonzero(number == k)
            found[which, :, slot] = pictures[k].levels(middles[which], sides[part[which]])
        alike = found @ found.swapaxes(2, 3)  # [S, M, PHOTOS, PHOTOS]
        alike[:, :, range(len(number)), range(len(number))] = -1
        result[part] = np.sort(alike, 3)[..., -(FEWEST - 1) :].mean(3).max(2)

    parts = np.array_split(np.flatnonzero(shown.sum(0) >= FEWEST), len(normal) // BATCH + 1)
    for _ in threads(compare, [(part,) for part in parts if len(part)]):
        pass
    return result


def best_places(score: np.ndarray, moves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The moves at which the photos agree most [P], between the evenly spaced `moves` [M] with scores [P, M] from
    `patch_correlation`, and their trust [P]."""
    best = score.argmax(1)
    middle = best.clip(1, len(moves) - 2)
    before, here, after = (score[np.arange(len(score)), middle + k] for k in (-1, 0, 1))
    shift = ((after - before) / (2 * np.maximum(2 * here - before - after, 1e-6))).clip(-1, 1)
    trust = ((here - ALIKE) / (SURE - ALIKE)).clip(0, 1) ** 2
    return moves[middle] + shift * (moves[1] - moves[0]), np.where(best == middle, trust, 0)


def settled(mesh: Mesh, normal: np.ndarray, mean: csr_matrix, wanted: np.ndarray, trust: np.ndarray,
            stay: np.ndarray) -> tuple[np.ndarray, bool]:  # fmt: skip
    """The move of each vertex [V] along its normal [V, 3]: the wanted one [V], weighted by trust [V], and smooth
    between. And whether the equations are solved.

    Shorter normals make vertices move less; `mean` [V, V] takes the mean of the neighbours, `stay` [V] is the trust in
    the old positions.
    """
    bend = mean - diags(np.ones(len(trust)))
    inwards = ((bend @ mesh.vertices) * normal).sum(1)
    matrix = diags(trust + stay) + BENDING * (bend.T @ bend)
    right = trust * wanted - BENDING * (bend.T @ inwards)
    moved, failed = cg(matrix.tocsr(), right, rtol=1e-3, maxiter=STEPS)
    return moved, failed == 0 and bool(np.isfinite(moved).all())
