"""Agreement of photographs: known shifts and one spoiled photograph are found, and nothing where all is well."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")

from train import shots, two_spheres  # noqa: E402

from mi_ntf.data import schema  # noqa: E402
from mi_ntf.data.images import levels  # noqa: E402
from mi_ntf.train import agreement, report, scoring  # noqa: E402
from mi_ntf.train.monitor import Notes  # noqa: E402
from mi_ntf.train.training_data import TrainingData  # noqa: E402

VIEWS, SIDE, FOCAL, BALL = 9, 40, 45.0, 0.95
C2W = shots.around(VIEWS, 3.0, seed=6)
NAMES = tuple(f"IMG_{i:04d}.jpg" for i in range(VIEWS))
WAVES = np.random.default_rng(0).normal(size=(3, 4, 3)) * 9
"""A wave of 5 to 20 pixels for each colour and some phases, of the direction that a pixel looks."""
RANDOM = np.random.default_rng(1).normal(size=(VIEWS, 2))
RANDOM -= np.median(RANDOM, axis=0)


def world(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Premultiplied RGBA (…, 4) along rays: a ball, of a colour that depends on the direction one looks in."""
    color = 0.3 + 0.06 * np.sin(np.einsum("ckj,...j->...ck", WAVES, d)).sum(-1)
    inside = ((o * o).sum(-1) - (o * d).sum(-1) ** 2 < BALL**2)[..., None]
    return np.concatenate([color, np.ones_like(color[..., :1])], -1) * inside


def pictures(moved: np.ndarray, factor: int = 4) -> np.ndarray:
    """(VIEWS, SIDE, SIDE, 4) photographs that are `moved` (VIEWS, 2) pixels to the right and down."""
    n = SIDE * factor
    actual = world(*schema.pixel_rays(C2W, FOCAL * factor, n, n, (SIDE / 2 + moved) * factor))
    return np.float32(actual.reshape(VIEWS, SIDE, factor, SIDE, factor, 4).mean((2, 4)))


@pytest.fixture(autouse=True)
def field(monkeypatch):
    """The field is that world, seen through pixels as wide as the photographs'."""
    def render(view, rays, *_):
        o, d = rays.o.double().numpy(), rays.d.double().numpy()
        right = np.cross(d, (0.31, 0.5, 0.81))
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        place = (np.arange(4) - 1.5) / 4 / FOCAL
        observed = [world(o, d + a * right + b * np.cross(right, d)) for a in place for b in place]
        return scoring.Pixels(torch.as_tensor(np.mean(observed, 0)[:, :3], dtype=torch.float32), None, None, None)

    monkeypatch.setattr(scoring.FieldView, "render", render)


def survey(images: np.ndarray, gains: torch.Tensor | None = None) -> tuple[agreement.Agreement, list[str]]:
    """Return the agreement of the photographs, and the complaints about them."""
    split = shots.split(images, FOCAL, C2W, names=NAMES)
    actual = agreement.survey(scoring.FieldView(None, None, 0.01), shots.Photographs(split), gains)
    assert actual.psnr.shape == (VIEWS,) and actual.shift.shape == (VIEWS, 2)
    return actual, report.complaints(actual, {"train": split})


def test_photographs_that_agree_are_quiet():
    """Exactly, and as 8-bit levels, and with noise of 1 %."""
    # Outlines are seen through pixels that are turned otherwise.
    exact, quiet = survey(pictures(np.zeros((VIEWS, 2))))
    assert quiet == [] and exact.moved < 2e-3 and float(exact.psnr.min()) > 45
    noise = np.random.default_rng(2).normal(size=(VIEWS, SIDE, SIDE, 3)) * 0.01
    noisy = pictures(np.zeros((VIEWS, 2)))
    noisy[..., :3] *= 1 + noise
    for images in (levels(pictures(np.zeros((VIEWS, 2)))), noisy.astype(np.float16)):
        actual, quiet = survey(images)
        assert quiet == [] and actual.moved < 0.05 and actual.outliers() == []


@pytest.mark.parametrize("size", [0.3, 0.8])
def test_known_shifts_are_found(size):
    """Within 15 %, right and down, of each and of all; the warning says how much, in pixels and degrees."""
    moved = size * RANDOM
    actual, said = survey(pictures(moved))
    np.testing.assert_allclose(actual.shift, moved, atol=0.15 * size)
    rms = np.sqrt((moved**2).sum(1).mean())
    assert actual.moved == pytest.approx(rms, rel=0.15)
    said = [text for text in said if "disagree" not in text]  # those of no shift at all agree very well
    if rms < agreement.MOVED:
        assert said == []
        return
    assert len(said) == 1, said
    assert said[0].startswith(f"warning: the photographs are moved against each other by {actual.moved:.2g} pixels "
                              f"({np.degrees(np.arctan(actual.moved / FOCAL)):.2g} degrees) and probably twice that")
    # A field that is moved as a whole has learned it so.
    together, _ = survey(pictures(moved + np.array([0.4, -0.3])))
    assert together.moved == pytest.approx(rms, rel=0.15)
    np.testing.assert_allclose(together.shift.median(0).values, [0.4, -0.3], atol=0.15)


def test_poses_of_captures_are_not_doubted(tmp_path):
    """The renderer has placed the cameras: what looks like a shift is an error of the field."""
    folder = two_spheres.write(tmp_path / "set", {"train": 2, "val": 1, "test": 1}, size=8)
    assert not TrainingData.load(folder, Notes(False), {}).posed
    (folder / "capture.json").write_text("{}")
    assert TrainingData.load(folder, Notes(False), {}).posed
    actual, said = survey(pictures(0.8 * RANDOM))
    assert len(said) == 1
    split = shots.split(pictures(0.8 * RANDOM), FOCAL, C2W, names=NAMES)
    assert report.complaints(actual, {"train": split}, posed=True) == []


def test_errors_of_the_field_are_no_shift():
    """Half of each photograph is moved, each in another direction, as it looks where edges of the field are soft.

    The halves do not agree on a shift, so the poses are not doubted.
    """
    still, moved = pictures(np.zeros((VIEWS, 2))), pictures(0.8 * RANDOM)
    still[:, :, :SIDE // 2] = moved[:, :, :SIDE // 2]
    actual, said = survey(still)
    apart = actual.shift - actual.shift.median(0).values
    assert float(apart.square().sum(1).mean().sqrt()) > agreement.MOVED
    assert actual.moved < agreement.MOVED and not any("moved against" in text for text in said)


@pytest.mark.parametrize(("psnr", "words"), [
    (31.2, "the field is good: test views have 31.2 dB"), (30.0, "good"), (29.9, "usable"), (25.0, "usable"),
    (24.9, "poor: test views have 24.9 dB; train for longer with --continue, or look at the photographs")])
def test_a_verdict_in_words(psnr, words):
    assert words in report.verdict(psnr)


def test_a_spoiled_photograph_is_named():
    """A photograph of another place, in turn; the noise of the others is allowed for."""
    rng = np.random.default_rng(4)
    for spoiled in (0, 5):
        images = pictures(np.zeros((VIEWS, 2)))
        images[..., :3] *= 1 + 0.02 * rng.normal(size=images[..., :3].shape)
        images[spoiled, ..., :3] = images[spoiled, :, ::-1, :3]
        actual, said = survey(np.float16(images))
        assert actual.outliers() == [spoiled]
        said = [text for text in said if "disagree" in text]
        assert len(said) == 1 and said[0].startswith(
            f"warning: 1 of {VIEWS} photographs disagree with the others beyond their gains: {NAMES[spoiled]} "
            f"({actual.psnr[spoiled]:.1f} dB), where the median is {actual.psnr.median():.1f} dB; look for motion")


def test_gains_are_no_disagreement():
    factors = torch.as_tensor(2 ** np.random.default_rng(3).uniform(-0.7, 0.7, (VIEWS, 3)), dtype=torch.float32)
    images = pictures(np.zeros((VIEWS, 2))) * np.append(factors.numpy(), np.ones((VIEWS, 1)), 1)[:, None, None]
    actual, said = survey(np.float32(images), factors)
    assert said == [] and float(actual.psnr.min()) > 45
    assert float(survey(np.float32(images))[0].psnr.max()) < 40


def test_a_photograph_without_the_object_is_left_out():
    images = pictures(0.8 * RANDOM)
    images[3] = 0
    actual, said = survey(images)
    assert actual.psnr.isnan().nonzero()[:, 0].tolist() == [3] and actual.outliers() == [] and not actual.shift[3].any()
    assert len(said) == 1 and "moved against each other" in said[0]
