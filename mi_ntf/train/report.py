"""Page beside a trained field: pictures of it, differences between the photographs, faults of the run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..data.page import Page
from ..data.schema import Split
from . import device
from .agreement import MOVED, PIXELS, Agreement, survey
from .checkpoint import State
from .flash import Flash
from .monitor import Notes, Validation
from .photometry import fitted
from .rays import Photographs, Rays
from .scoring import FieldView, Light, Pixels, srgb
from .training_data import TrainingData
from .transmittance_targets import TransmittanceTargets

Report = State
"""Report of a run, in JSON types."""
SHOWN = 3
"""Number of test photographs on the page."""
WIDTH = 256
"""Pixels of the longer side of these photographs."""
LAMPS = 8
"""Positions of the lamp that goes around the object."""
LAMP_WIDTH = 180
"""Pixels of the longer side of the pictures under this lamp."""
GOOD, USABLE = 30.0, 25.0
"""PSNR of the test views, dB, from which a field is good, and from which it is usable."""


def verdict(psnr: float) -> str:
    """Return a sentence on the quality of a field, by the PSNR of its test views in dB."""
    if psnr >= GOOD:
        return f"the field is good: test views have {psnr:.1f} dB"
    if psnr >= USABLE:
        return f"the field is usable: test views have {psnr:.1f} dB; more minutes with --continue make it finer"
    return (f"the field is poor: test views have {psnr:.1f} dB; train for longer with --continue, or look at the "
            "photographs with `mi-ntf inspect`")


def complaints(agreement: Agreement, splits: dict[str, Split], posed: bool = False) -> list[str]:
    """Return a sentence for each fault of the photographs; `posed` is true if their poses are known to be exact."""
    if not agreement.known:
        return ["warning: the field has hardly learned the photographs, whose poses and masks cannot be judged by it; "
                "train for longer with --continue, or look at them with `mi-ntf inspect`"]
    texts, names = [], splits["train"].names
    if agreement.moved > MOVED and not posed:
        width = splits["train"].focal.mean()
        degrees = float(torch.rad2deg(torch.tensor(agreement.moved / width)))
        texts.append(f"warning: the photographs are moved against each other by {agreement.moved:.2g} pixels "
                     f"({degrees:.2g} degrees) and probably twice that, so their poses are not exact; fine detail is "
                     "lost. Run `colmap bundle_adjuster`, or make the poses anew from sharper photographs")
    outliers = agreement.outliers()
    if outliers:
        listed = ", ".join(f"{names[i] if names else i} ({agreement.psnr[i]:.1f} dB)" for i in outliers[:8])
        texts.append(f"warning: {len(outliers)} of {len(agreement.psnr)} photographs disagree with the others beyond "
                     f"their gains: {listed}, where the median is {float(agreement.psnr.nanmedian()):.1f} dB; look for "
                     "motion, a wrong pose or mask, or another light, and take them out")
    return texts


def scored_pixels(data: TrainingData) -> int:
    """Return the number of pixels that scores and :func:`judge` render."""
    return 2 * len(data.photographs["val"]) + 2 * len(data.photographs["test"]) + PIXELS * len(data.splits["train"].c2w)


def page_pixels(data: TrainingData) -> int:
    """Return the number of pixels that :func:`publish` renders; those under the lamp count twice, with shadows."""
    pool = data.photographs["test"]
    shown, lit = (len(pool.frame(0, _stride(pool, width))[0]) for width in (WIDTH, LAMP_WIDTH))
    return 2 * SHOWN * shown + 2 * LAMPS * lit


def judge(field: FieldView, data: TrainingData, gains: torch.Tensor | None, notes: Notes, report: Report,
          detail: float = 1.0) -> Agreement:
    """Judge the photographs by the finished `field`; add the result to `report` and `notes`.

    `gains` (views, 3) are those of the photographs, if they are learned. `detail` is the fraction of the pixels to
    compare.
    """
    agreement = survey(field, data.train, gains, round(detail * PIXELS))
    for text in complaints(agreement, data.splits, data.posed):
        notes.add(text)
    report["notes"] = notes.texts
    report["photographs"] = {"moved": round(agreement.moved, 3)}
    if gains is not None:
        names = data.train.names or tuple(map(str, range(len(gains))))
        values = ([float(f"{v:.4g}") for v in row] for row in gains.tolist())
        report["photographs"]["gains"] = dict(zip(names, values, strict=True))
    bounced = field.light.bounced
    if bounced is not None and bounced.room is not None:
        report["photographs"]["room"] = bounced.room.detach().exp().tolist()
    return agreement


def publish(field: FieldView, data: TrainingData, gains: torch.Tensor | None, agreement: Agreement, report: Report,
            trace: list[tuple[int, float]], marched: TransmittanceTargets, out: Path, detail: float = 1.0) -> None:
    """Write the page beside the field file `out`.

    `trace` holds steps and running means of the loss, `marched` the density of the field. Pictures have the fraction
    `detail` of their pixels.
    """
    page = Page(out.name)
    _summary(page, report, field.light.fit)
    _test_views(page, field, data.photographs["test"], detail)
    _turning_lamp(page, field, data.photographs["test"], marched, detail)
    _curves(page, report["history"], trace)
    _photographs(page, data.train.names, agreement, gains)
    page.write(out.with_suffix(".html"))


def _summary(page: Page, report: Report, fit: bool) -> None:
    """Add verdict, scores, notes and faults; `fit` is true if gains were fitted to held-out photographs."""
    page.text(f"{report['verdict']}.".replace("the", "The", 1))
    rows: list[list[object]] = [["steps", report["steps_done"]], ["minutes", f"{report['seconds'] / 60:.1f}"]]
    for name, title in (("val", "validation"), ("test", "test views")):
        scores = report[name]
        rows.append([f"{title}: PSNR of sRGB, whole image", f"{scores['srgb']:.2f} dB"])
        rows.append([f"{title}: the object alone", f"{scores['object']:.2f} dB"])
    if fit:
        rows.append(["gains of held-back views", "fitted to them before they are compared, one factor a channel"])
    page.table(["", ""], rows)
    for note in report["notes"]:
        (page.warning if note.startswith("warning: ") else page.text)(note.removeprefix("warning: "))
    for fault in report["faults"]:
        page.warning(f"step {fault['step']}: {fault['reason']}; rolled back")


def _test_views(page: Page, field: FieldView, photographs: Photographs, detail: float) -> None:
    """Add photographs beside renderings of the field."""
    page.section("Test views")
    for number in torch.linspace(0, photographs.views - 1, min(SHOWN, photographs.views)).round().long().tolist():
        rays, shape = _rays(photographs, number, WIDTH, detail)
        pixels = _render(field, rays)
        target = rays.target[:, :3]
        color = pixels.color * fitted(pixels.color, target) if field.light.fit else pixels.color
        difference = 4 * (srgb(color) - srgb(target)).abs()
        name = photographs.names[number] if photographs.names else f"view {number}"
        page.pictures([(caption, _levels(values, shape)) for caption, values in (
            (name, srgb(target)), ("field", srgb(color)), ("4 × difference", difference),
            ("normals", (pixels.normal + pixels.alpha[:, None]) / 2), ("albedo", srgb(pixels.albedo)))], 200)


def _turning_lamp(page: Page, field: FieldView, photographs: Photographs, marched: TransmittanceTargets, detail: float
                  ) -> None:
    """Add the first photograph under a lamp that goes around the object, at the camera's height and distance."""
    page.section("Under a turning lamp")
    rays, shape = _rays(photographs, 0, LAMP_WIDTH, detail)
    rays = replace(rays, view=torch.zeros_like(rays.view))
    skins = field.networks.phase is None and (field.light.flash is None or field.light.flash.solid)
    lamp = Flash([photographs], skins, marched)
    camera = lamp.camera[0]
    up = lamp.rotation[0, :, 1]
    pictures, exposure = [], 1.0
    for turn in range(LAMPS):
        angle = torch.tensor(2 * torch.pi * turn / LAMPS)
        across = torch.linalg.cross(up, camera)
        along = up * (up @ camera)
        place = along + (camera - along) * angle.cos() + across * angle.sin()
        lamp.place = (place + 0.3 * camera.norm() * up)[None]
        color = _render(replace(field, light=Light(None, lamp)), rays, 1).color
        if turn == 0:
            bright = color.amax(1)
            exposure = 0.8 / max(float(bright[bright > 0].quantile(0.98)) if bool(bright.any()) else 1.0, 1e-9)
        pictures.append((f"{360 * turn // LAMPS}°", _levels(srgb(color * exposure), shape)))
    page.pictures(pictures, 200)


def _curves(page: Page, history: list[Validation], trace: list[tuple[int, float]]) -> None:
    page.section("Training")
    steps = [entry["step"] for entry in history]
    page.curves("Validation", {"PSNR": (steps, [entry["psnr"] for entry in history])}, "step", "dB")
    if trace:
        traced, loss = zip(*trace, strict=True)
        page.curves("Loss, running mean", {"loss": (traced, loss)}, "step", "")


def _photographs(page: Page, names: tuple[str, ...], agreement: Agreement, gains: torch.Tensor | None) -> None:
    """Add the differences of the photographs of the training split."""
    page.section("Photographs for training")
    numbers = list(range(len(agreement.psnr)))
    if gains is not None:
        page.curves("Gains", {c: (numbers, gains[:, i].tolist()) for i, c in enumerate(("red", "green", "blue"))},
                    "photograph", "", log=True)
    rows: list[list[object]] = [
        [names[i] if names else i, f"{agreement.psnr[i]:.1f}",
         f"{agreement.shift[i, 0]:+.2f}, {agreement.shift[i, 1]:+.2f}",
         "" if gains is None else " ".join(f"{g:.3f}" for g in gains[i])] for i in numbers]
    page.table(["photograph", "PSNR of the object, dB", "shift, pixels", "gains"], rows,
               folded=f"{len(rows)} photographs")


def _stride(photographs: Photographs, width: float) -> int:
    """Return the number of pixels per pixel of a picture whose longer side has about `width` of them."""
    longer: int = max(photographs.height, photographs.width)
    return max(1, round(longer / width))


def _rays(photographs: Photographs, number: int, width: int, detail: float) -> tuple[Rays, tuple[int, int]]:
    """Return the rays of photograph `number`, scaled to about `width` pixels at `detail` 1, and the picture's shape."""
    pixels, rows, columns = photographs.frame(number, _stride(photographs, width * detail**0.5))
    return photographs[pixels], (rows, columns)


def _render(field: FieldView, rays: Rays, passes: int = 2) -> Pixels:
    return field.render(rays, device.generator(1), passes)


def _levels(values: torch.Tensor, shape: tuple[int, int]) -> np.ndarray:
    """Return an 8-bit picture (h, w, 3) of sRGB values (h·w, 3)."""
    levels: np.ndarray = (values.clamp(0, 1) * 255).round().to(torch.uint8).view(*shape, 3).cpu().numpy()
    return levels
