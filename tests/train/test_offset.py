"""Position of the flash beside the lens, estimated from shading that was computed for a known position."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")

import torch.nn.functional as F  # noqa: E402
from train import shots  # noqa: E402

from mi_ntf.data import schema  # noqa: E402
from mi_ntf.train import offset  # noqa: E402
from mi_ntf.train.flash import Flash  # noqa: E402
from mi_ntf.train.normal_targets import NormalTargets  # noqa: E402
from mi_ntf.train.occupancy import Occupancy  # noqa: E402
from mi_ntf.train.transmittance_targets import TransmittanceTargets  # noqa: E402

VIEWS, RADIUS, DISTANCE = 30, 0.6, 3.2
C2W = shots.around(VIEWS, DISTANCE, seed=1)


def flashes() -> Flash:
    """The lights as training knows them: at the lenses, and some of held-back photographs after them."""
    blank = np.zeros((VIEWS, 1, 1, 4), np.uint8)
    return Flash([shots.photographs(blank, c2w=C2W), shots.photographs(blank[:2], c2w=C2W[:2], first=VIEWS)], True,
                 TransmittanceTargets())


def observed(place: tuple[float, float, float], points: int = 500, outliers: float = 0.15) -> offset.Observed:
    """Points of a sphere of varying albedo under lights at `place` from the lenses, in photographs of gains from 0.5 to
    2; of them some in cast shadow and some in highlights, all that face away from the light in the dark, 3 % noise."""
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(points, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    x = RADIUS * normal
    right, up, forward = place
    path = (C2W @ (right, up, -forward, 1.0))[:, None, :3] - x
    distance = np.linalg.norm(path, axis=2)
    cosine = (path * normal).sum(2) / distance
    value = rng.uniform(-2, 0, points) + rng.uniform(-0.7, 0.7, (VIEWS, 1)) + np.log(cosine.clip(0.01))
    value = value - 2 * np.log(distance) + 0.03 * rng.normal(size=value.shape)
    kind = rng.uniform(size=value.shape)
    value = np.where(kind < outliers / 2, value - rng.uniform(0.5, 3, value.shape), value)
    value = np.where(kind > 1 - outliers / 2, value + rng.uniform(0.3, 2, value.shape), value)
    toward = C2W[:, None, :3, 3] - x
    shown = (toward * normal).sum(2) / np.linalg.norm(toward, axis=2) > offset.FACING
    return offset.Observed(*(torch.as_tensor(v, dtype=torch.float32) for v in (x, normal, value * shown, shown)))


def degrees_apart(a, b) -> float:
    """Between the directions of two places, right, up, forward of a lens, as the object's centre sees them."""
    a, b = (np.array([v[0], v[1], DISTANCE - v[2]]) for v in (np.asarray(a, float), np.asarray(b, float)))
    return float(np.degrees(np.arccos(min(a @ b / np.linalg.norm(a) / np.linalg.norm(b), 1))))


@pytest.mark.parametrize(("place", "within"), [((0.9, 0.6, 0.0), 1), ((-1.1, 0.1, 0.0), 1), ((0.2, -0.35, 0.0), 1),
                                               ((0.1, 1.9, 0.0), 1), ((0.0, 0.0, 0.0), 1), ((0.8, -0.5, 0.4), 2)])
def test_a_known_place_is_found(place, within):
    """To a degree; what it is nearer to the object than the lens is not looked for, and changes the direction by some.
    """
    data, lights = observed(place), flashes()
    actual = offset.estimate(data, lights, VIEWS, DISTANCE)
    assert actual.shape == (3,) and float(actual[2]) == 0
    assert degrees_apart(actual, place) < within, actual
    there, lens = (offset.cost(data, lights.places(torch.tensor(v))[:VIEWS]) for v in (place, (0.0, 0.0, 0.0)))
    assert 0 <= there <= lens < 1 and (there < 0.7 * lens or not any(place))


def test_few_points_tell_nothing():
    lights = flashes()
    assert offset.estimate(observed((0.9, 0.6, 0.0), offset.FEWEST - 1), lights, VIEWS, DISTANCE) is None
    assert offset.estimate(observed((0.9, 0.6, 0.0), offset.FEWEST), lights, VIEWS, DISTANCE) is not None


HUE = torch.tensor([0.7, -0.4, 0.5])
CENTRE = torch.tensor([0.1, -0.05, 0.0])
"""Off the middle, so that a mirrored or turned camera would see other points."""


class Ball:
    """σ = e⁶ within RADIUS of CENTRE."""

    def log_density(self, x):
        return torch.where((x - CENTRE).norm(dim=1) < RADIUS, 6.0, -12.0)

    def density(self, x):
        return self.log_density(x).exp()


def test_what_photographs_show_of_points():
    """A ball whose colour is e^(a·x) in all of them: read at a point's pixel, where that is seen and in the picture."""
    size, focal, views = 48, np.array([150.0, 200.0]), 24  # 0.8 of the ball's width fits in, and 0.6 of its height
    c2w = shots.around(views, DISTANCE, seed=4)
    o, d = schema.pixel_rays(c2w, focal, size, size)
    o = o - CENTRE.numpy()
    along = -(o * d).sum(-1)
    square = along**2 - (o**2).sum(-1) + RADIUS**2
    hit = square > 0
    x = o + (along - np.sqrt(square.clip(0)))[..., None] * d + CENTRE.numpy()
    picture = np.concatenate([np.exp(x @ HUE.numpy())[..., None] * [0.5, 1, 2], np.ones((views, size, size, 1))], -1)
    picture = (picture * hit[..., None]).astype(np.float32)
    picture[:, :20, :20, :3] = 0  # dark, as shadows are
    pool = shots.photographs(picture, focal=focal, c2w=c2w)
    baked, marched = NormalTargets(96), TransmittanceTargets()
    grid = Occupancy(torch.ones((64,) * 3, dtype=torch.bool))
    baked.update(Ball(), grid)
    marched.update(Ball(), grid)
    data = offset.observe(pool, pool[pool.random(1500, torch.Generator().manual_seed(0))], baked, marched)
    count = len(data.x)
    assert count > 500 and data.value.shape == data.used.shape == (views, count) and data.normal.shape == (count, 3)
    np.testing.assert_allclose((data.x - CENTRE).norm(dim=1), RADIUS, atol=0.02)  # voxels of 1/64
    assert float((data.normal * F.normalize(data.x - CENTRE, dim=1)).sum(1).min()) > 0.98  # steps of 1/48, blurred
    used = data.used > 0
    assert ((data.used == 0) | (data.used == 1)).all() and (data.used.sum(0) >= 3).all()
    error = (data.value - data.x @ HUE)[used]
    # A pixel is 0.02 wide at the ball, more at its rim; the points are off its surface by a voxel.
    assert float(error.abs().quantile(0.95)) < 0.03 and abs(float(error.mean())) < 0.005
    # What is used is what faces the camera and is in the picture, apart from points at the limits of either.
    sure, never = torch.zeros_like(used), torch.zeros_like(used)
    for number in range(views):
        path = pool.origin[number].float() - data.x
        cosine = (path * (data.x - CENTRE)).sum(1) / RADIUS / path.norm(dim=1)
        local = -path.double() @ pool.rotation[number]
        at = local[:, :2] / -local[:, 2:] * torch.tensor([1, -1]) * torch.as_tensor(focal) + size / 2
        inside = (at > 1).all(1) & (at < size - 1).all(1)
        dark = (at < 21).all(1)
        sure[number] = (cosine > offset.FACING + 0.2) & inside & ~dark
        never[number] = (cosine < offset.FACING - 0.2) | ((at < -1) | (at > size + 1)).any(1) | (at < 19).all(1)
    never &= ~sure
    assert 0.15 < float(sure.float().mean()) < float(1 - never.float().mean()) < 0.6
    assert used[sure].float().mean() > 0.99 and not used[never].any()


def test_levels_at_their_upper_end_are_not_used():
    pool = shots.photographs(np.full((3, 9, 9, 4), 255, np.uint8), c2w=np.stack([shots.facing(p) for p in (
        (0, 0, 3.0), (0.5, 0, 3.0), (0, 0.5, 3.0))]))
    baked, marched = NormalTargets(64), TransmittanceTargets()
    grid = Occupancy(torch.ones((64,) * 3, dtype=torch.bool))
    baked.update(Ball(), grid)
    marched.update(Ball(), grid)
    assert not len(offset.observe(pool, pool[:], baked, marched).x)
    pool.stored[:, :3] = 200
    assert len(offset.observe(pool, pool[:], baked, marched).x) > 50
