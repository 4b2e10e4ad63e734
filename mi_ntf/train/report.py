"""The page beside a trained field: what it looks like, what was found out about the photographs, what went wrong."""

from dataclasses import replace
from pathlib import Path

import torch

from ..data.page import Page
from ..data.schema import Split
from . import device
from .agreement import MOVED, Agreement, survey
from .flash import Flash
from .networks import Networks
from .occupancy import Occupancy
from .photometry import fitted
from .rays import Photographs, Rays
from .recipe import Recipe
from .scoring import Light, render_all, srgb
from .transmittance_targets import TransmittanceTargets

SHOWN = 3
"""Test photographs on the page …"""
WIDTH = 256
"""… and how many pixels of their longer side."""
TURNS = 8
"""Places of the lamp that goes around the object …"""
TURNED = 180
"""… and how many pixels of the longer side then."""


def complaints(agreement: Agreement, splits: dict[str, Split]) -> list[str]:
    """A sentence for each thing that is wrong with the photographs."""
    found, names = [], splits["train"].names
    if not agreement.known:
        return ["warning: the field has hardly learned the photographs, whose poses and masks cannot be judged by it; "
                "train for longer, or look at them with `mi-ntf inspect`"]
    if agreement.moved > MOVED:
        width = splits["train"].focal.mean()
        degrees = float(torch.rad2deg(torch.tensor(agreement.moved / width)))
        found.append(f"warning: the photographs are moved against each other by {agreement.moved:.2g} pixels "
                     f"({degrees:.2g} degrees) and probably twice that, so their poses are not exact; fine detail is "
                     "lost. Run `colmap bundle_adjuster`, or make the poses anew from sharper photographs")
    bad = agreement.outliers()
    if bad:
        which = ", ".join(f"{names[i] if names else i} ({agreement.psnr[i]:.1f} dB)" for i in bad[:8])
        found.append(f"warning: {len(bad)} of {len(agreement.psnr)} photographs disagree with the others beyond their "
                     f"gains: {which}, where the median is {float(agreement.psnr.nanmedian()):.1f} dB; look for "
                     "motion, a wrong pose or mask, or another light, and take them out")
    return found


def photographs(run: Recipe, stored: Networks, occupancy: Occupancy, report: dict, most: float) -> Agreement:
    """What the finished field, as `stored`, tells of the photographs of the `run`, from `most` pixels or so: into the
    `report`; complains."""
    gains = None if run.gains is None else run.gains.all().detach()
    found = survey(stored, occupancy, run.photographs["train"], gains, run.config.step, run.light, most)
    for text in complaints(found, run.splits):
        run.note(text)
    report["notes"] = run.notes
    report["photographs"] = {"moved": round(found.moved, 3)}
    if gains is not None:
        names = run.splits["train"].names or tuple(map(str, range(len(gains))))
        values = ([round(v, 4) for v in row] for row in gains.tolist())
        report["photographs"]["gains"] = dict(zip(names, values, strict=True))
    return found


def publish(run: Recipe, stored: Networks, occupancy: Occupancy, agreement: Agreement, report: dict,
            trace: list[list[float]], out: Path) -> None:
    """Write the page beside the field `out`; `trace`: steps and running means of the loss."""
    page = Report(out.name, stored, occupancy, run.config.step, run.light)
    page.summary(report, run.notes)
    page.views(run.photographs["test"])
    page.turning(run.photographs["test"])
    page.curves(report["history"], trace)
    gains = None if run.gains is None else run.gains.all().detach()
    page.photographs(run.splits["train"].names, agreement, gains)
    page.write(out.with_suffix(".html"))


class Report:
    """Collects what the page shows of a field in `networks` and its photographs."""

    def __init__(self, title: str, networks: Networks, occupancy: Occupancy, step: float, light: Light):
        self.page = Page(title)
        self.networks, self.occupancy, self.step, self.light = networks, occupancy, step, light

    def summary(self, report: dict, notes: list[str]) -> None:
        """Scores, and what was said in the course of the run."""
        rows = [["steps", report["steps_done"]], ["minutes", f"{report['seconds'] / 60:.1f}"]]
        for name, title in (("val", "validation"), ("test", "test views")):
            scores = report[name]
            rows.append([f"{title}: PSNR of sRGB, whole image", f"{scores['srgb']:.2f} dB"])
            rows.append([f"{title}: the object alone", f"{scores['object']:.2f} dB"])
        if self.light.fit:
            rows.append(["gains of held-back views", "fitted to them before they are compared, one factor a channel"])
        self.page.table(["", ""], rows)
        for note in notes:
            (self.page.warning if note.startswith("warning: ") else self.page.text)(note.removeprefix("warning: "))
        for fault in report["faults"]:
            self.page.warning(f"step {fault['step']}: {fault['reason']}; rolled back")

    def views(self, photographs: Photographs) -> None:
        """Photographs beside what the field makes of them."""
        self.page.section("Test views")
        for number in torch.linspace(0, photographs.views - 1, min(SHOWN, photographs.views)).round().long().tolist():
            rays, shape = self._rays(photographs, number)
            color, alpha, normal, albedo = self._render(rays, self.light)
            target = rays.target[:, :3]
            color = color * fitted(color, target) if self.light.fit else color
            apart = 4 * (srgb(color) - srgb(target)).abs()
            name = photographs.names[number] if photographs.names else f"view {number}"
            self.page.pictures([(caption, _levels(values, shape)) for caption, values in (
                (name, srgb(target)), ("field", srgb(color)), ("4 × difference", apart),
                ("normals", (normal + alpha[:, None]) / 2), ("albedo", srgb(albedo)))], 200)

    def turning(self, photographs: Photographs) -> None:
        """The first photograph under a lamp that goes around the object, at the camera's height and distance."""
        self.page.section("Under a turning lamp")
        rays, shape = self._rays(photographs, 0, TURNED)
        rays = replace(rays, view=torch.zeros_like(rays.view))
        lamp = Flash([photographs], self.light.flash is None or self.light.flash.solid, self._marched())
        camera = lamp.camera[0]
        up = lamp.rotation[0, :, 1]
        pictures, exposure = [], 1.0
        for turn in range(TURNS):
            angle = torch.tensor(2 * torch.pi * turn / TURNS)
            across = torch.linalg.cross(up, camera)
            along = up * (up @ camera)
            place = along + (camera - along) * angle.cos() + across * angle.sin()
            lamp.place = (place + 0.3 * camera.norm() * up)[None]
            color, *_ = self._render(rays, Light(None, lamp), 1)
            if turn == 0:
                bright = color.amax(1)
                exposure = 0.8 / max(float(bright[bright > 0].quantile(0.98)) if bool(bright.any()) else 1.0, 1e-9)
            pictures.append((f"{360 * turn // TURNS}°", _levels(srgb(color * exposure), shape)))
        self.page.pictures(pictures, 200)

    def curves(self, history: list[dict], trace: list[list[float]]) -> None:
        self.page.section("Training")
        steps = [entry["step"] for entry in history]
        self.page.curves("Validation", {"PSNR": (steps, [entry["psnr"] for entry in history])}, "step", "dB")
        if trace:
            when, loss = zip(*trace, strict=True)
            self.page.curves("Loss, running mean", {"loss": (when, loss)}, "step", "")

    def photographs(self, names: tuple[str, ...], agreement: Agreement, gains: torch.Tensor | None) -> None:
        """What each photograph for training differs by."""
        self.page.section("Photographs for training")
        numbers = list(range(len(agreement.psnr)))
        if gains is not None:
            self.page.curves("Gains", {c: (numbers, gains[:, i].tolist())
                                       for i, c in enumerate(("red", "green", "blue"))}, "photograph", "", log=True)
        rows = [[names[i] if names else i, f"{agreement.psnr[i]:.1f}",
                 f"{agreement.shift[i, 0]:+.2f}, {agreement.shift[i, 1]:+.2f}",
                 "" if gains is None else " ".join(f"{g:.3f}" for g in gains[i])] for i in numbers]
        self.page.table(["photograph", "PSNR of the object, dB", "shift, pixels", "gains"], rows,
                        folded=f"{len(rows)} photographs")

    def write(self, path: Path) -> None:
        self.page.write(path)

    def _rays(self, photographs: Photographs, number: int, width: int = WIDTH) -> tuple[Rays, tuple[int, int]]:
        pixels, *shape = photographs.frame(number, max(1, round(max(photographs.height, photographs.width) / width)))
        return photographs[pixels], (shape[0], shape[1])

    def _render(self, rays: Rays, light: Light, passes: int = 2):
        return render_all(self.networks, rays, self.occupancy, self.step, device.generator(1), light, passes)

    def _marched(self) -> TransmittanceTargets:
        marched = TransmittanceTargets()
        marched.update(self.networks, self.occupancy)
        return marched


def _levels(values: torch.Tensor, shape: tuple[int, int]):
    """8-bit picture (h, w, 3) of sRGB values (h·w, 3)."""
    return (values.clamp(0, 1) * 255).round().to(torch.uint8).view(*shape, 3).cpu().numpy()
