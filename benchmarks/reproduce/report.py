"""``report.html`` and ``tables.tex`` of what is finished."""

from pathlib import Path

import numpy as np

from mi_ntf.core import files
from mi_ntf.data.page import GREY, Page, new_figure, plain

from . import costs as times
from . import images, paper, tables
from .compared import LIGHTS, METHODS, METRICS, TABLES, Sizes
from .jobs import Plan
from .results import Accuracy
from .tables import Table


class Report:
    """Of `rows`, those of the plan's jobs that are finished, by job. `folder`: for files; `quick`: sizes of --quick."""

    def __init__(self, plan: Plan, rows: dict[str, dict], quick: bool):
        self.plan, self.rows, self.quick = plan, rows, quick
        self.accuracy = Accuracy([r for r in rows.values() if "metrics" in r], plan.scenes)
        self.methods = self.accuracy.methods(METHODS)
        self.costs = rows.get("costs", {}).get("costs")

    def tables(self) -> dict[str, list[Table]]:
        """Those whose measurements are there, by name."""
        found: dict[str, list[Table]] = {name: [] for name in self.plan.tables}
        if "table2" in found and self.methods:
            found["table2"] = tables.table2(self.accuracy, self.methods) + (
                tables.drops(self.accuracy, self.methods) if len(self.methods) > 1 else [])
        if self.costs:
            made = {"table1": lambda: tables.table1(self.costs, self.plan.sizes.bench),
                    "complexity": lambda: tables.complexity(self.costs),
                    "maps": lambda: tables.maps(self.costs, self._built())}
            found |= {name: [make()] for name, make in made.items() if name in found}
        studies = {(r["scene"], r["network"]): r for r in self.rows.values() if "relative_rmse" in r}
        if "ablation" in found and studies:
            found["ablation"] = [tables.ablation(studies)]
        return found

    def write(self, failed: dict[str, str], machine: dict) -> tuple[Path, Path]:
        """Write both files; their paths. `failed`: job → why."""
        out, found = self.plan.out, self.tables()
        page = Page("Reproduction of Learning Neural Transmittance (Shafiei et al. 2021)")
        self._begin(page, failed, machine)
        for name in self.plan.tables:
            page.section(TABLES[name])
            for table in found[name]:
                page.text(table.title)
                page.table(table.header, table.rows, groups=table.groups)
                if table.note:
                    page.text(table.note)
            getattr(self, f"_{name}", lambda page: None)(page)
            if not found[name] and name not in ("curves", "runtime"):
                page.text("Nothing of it is finished.")
        self._end(page, failed)
        html, tex = out / "report.html", out / "tables.tex"
        page.write(html)
        text = "\n".join(tables.latex(t) for name in self.plan.tables for t in found[name])
        files.write(tex, "% Ours, and in brackets the paper's (Shafiei et al. 2021).\n" + text)
        return html, tex

    def _begin(self, page: Page, failed: dict[str, str], machine: dict) -> None:
        done = sum(job.name in self.rows for job in self.plan.jobs)
        page.text(f"{done} of {len(self.plan.jobs)} jobs are done. Ours first, the paper's figure in brackets. "
                  + ("--quick: small pictures, few lights, short trainings." if self.quick else "Full size."))
        if failed:
            page.warning(f"{_count(len(failed), 'job')} failed; why is at the end of the page. The same command tries "
                         "again.")
        for kind, light in LIGHTS.items():
            ssim, rmse = (self.accuracy.over_scenes("drop", kind, m, "TM") for m in ("ssim", "rmse"))
            if ssim.ours is not None and rmse.ours is not None:
                page.text(f"{light}, TM against NRF, mean of {_count(len(self.plan.scenes), 'scene')}: SSIM less by "
                          f"{ssim.ours:.4f} [{ssim.paper:.4f}], rMSE {rmse.ours:+.1%} [{rmse.paper:+.1%}].")
        page.section("What differs from the paper")
        page.table([""], [[text] for text in differences(self.plan.sizes, self.plan, machine)])

    def _table2(self, page: Page) -> None:
        few, many = self.accuracy.images()
        if many:
            missing = [METRICS[m] for m in METRICS if not self.accuracy.measured(m)]
            if missing:
                page.text(f"{' and '.join(missing)}: not measured here. MS-SSIM needs 176² pixels; LPIPS its package "
                          "and AlexNet's weights, `mi-ntf compare` says from where.")
            page.text(f"Means of {few} to {many} pictures of {self.plan.sizes.pixels}² pixels [400 and 18, of 600²]. "
                      "SSIM and MS-SSIM: more is better; LPIPS and rMSE: less. Drops: above 0 is worse than NRF.")
            body = [[LIGHTS[kind], name, len(s), f"{np.median(s):.1f}"] for (kind, name), s in
                    sorted(self.accuracy.seconds.items(), key=lambda item: (item[0][0] != "point", item[0][1]))]
            page.table(["light", "method", "pictures", "seconds, median"], body,
                       folded="Pictures, and the time that one takes here")
            if self.accuracy.shared:
                page.text(f"{self.accuracy.shared} of them were made by several workers at a time: their seconds are "
                          "longer than those of a picture alone.")

    def _runtime(self, page: Page) -> None:
        if not self.costs:
            page.text("Nothing of it is finished.")
            return
        lights = np.unique(np.geomspace(1, 500, 60).round().astype(int))
        figure = new_figure(9.5, 3.6)
        left, right = figure.subplots(1, 2)
        for (table, culled), label, style in ((times.MAP, "as in the paper", "-"), (times.OURS, "ours, culled", "--")):
            ours, base = times.overall(self.costs, self.plan.sizes.bench, lights, table, culled)
            left.plot(lights, ours, style, color="#3b82e0", label=f"TM, {label}")
            left.plot(lights, base, style, color="#e0433a", label=f"NRF, {label}")
            right.plot(lights, base / ours, style, color="#2f9e44", label=label)
        ends = [paper.TABLE1[kind]["overall"] for kind in LIGHTS]
        counts = [paper.LIGHTS[kind] for kind in LIGHTS]
        for k, colour in ((0, "#3b82e0"), (1, "#e0433a")):
            left.plot(counts, [e[k] for e in ends], "o", color=colour, markerfacecolor="none")
        left.plot([], [], "o", color=GREY, markerfacecolor="none", label="the paper's table 1")
        right.plot(counts, [e[2] for e in ends], "o", color=GREY, markerfacecolor="none", label="the paper's table 1")
        scaling = self.rows.get("scaling")
        if scaling:
            left.plot(scaling["lights"], scaling["seconds"], ".", color=GREY,
                      label=f"measured: shipped field, {scaling['pixels']}²")
        left.set(xlabel="lights", ylabel="seconds", xscale="log", yscale="log")
        right.set(xlabel="lights", ylabel="NRF over TM", yscale="log")
        _finish(left, right)
        page.figure(figure, "Seconds of a whole 600² picture by the number of lights, and how many times faster TM is. "
                    "Composed of measured costs, as table 1.", vector=True)

    def _maps(self, page: Page) -> None:
        built = self._built()
        if not self.costs:
            return
        figure = new_figure(6.5, 3.6)
        axes = figure.subplots()
        lights = np.array([1, 500])
        for (name, (width, height)), style in zip(tables.PICTURES.items(), ("-", "--", ":"), strict=True):
            ours, base = times.transmittance(self.costs, lights, *times.MAP, width * height)
            axes.plot(lights, ours, style, color="#3b82e0", label=f"TM, {name}")
            axes.plot(lights, base, style, color="#e0433a", label=f"NRF, {name}")
        for k, colour in ((0, "#3b82e0"), (1, "#e0433a")):
            theirs = [paper.TABLE1[kind]["transmittance"][k] for kind in LIGHTS]
            axes.plot([1, 500], theirs, "o", color=colour, markerfacecolor="none")
        axes.plot([], [], "o", color=GREY, markerfacecolor="none", label="the paper's table 1")
        for row in built.values():
            axes.plot(row["lights"], row["map"], ".", color="#3b82e0")
            axes.plot(row["lights"], row["volume"], ".", color="#e0433a")
        axes.set(xlabel="lights", ylabel="seconds", xscale="log", yscale="log")
        _finish(axes)
        page.figure(figure, "Seconds to make all maps or volumes by the number of lights. Dots: measured on the "
                    "shipped fields.", vector=True)

    def _curves(self, page: Page) -> None:
        row = self.rows.get("curves")
        if not row:
            page.text("Nothing of it is finished.")
            return
        marched, *others = row["curves"]
        figure = new_figure(10.5, 2.4 * -(-len(others) // 3))
        axes = np.atleast_1d(figure.subplots(-(-len(others) // 3), min(3, len(others)), squeeze=False)).ravel()
        for a, name in zip(axes, others, strict=False):
            a.plot(row["t"], row["curves"][marched], color="#e0433a", linewidth=1.2)
            a.plot(row["t"], row["curves"][name], color="#3b82e0", linewidth=1.2)
            a.set_title(name)
            a.set(ylim=(-0.05, 1.05), xticks=np.linspace(-1, 1, 5))
            plain(a)
        for a in axes[len(others):]:
            a.set_axis_off()
        page.figure(figure, f"τ along a ray of {row['scene']} by the place on it, towards the light; red: marched, "
                    "blue: the network's. The paper's panels are after 6000, 12000, 30000 and 670000 steps, in which "
                    "its field learns too.", vector=True)

    def _ablation(self, page: Page) -> None:
        for scene in self.plan.scenes:
            for light in self.plan.lights[scene.name]:
                if not light.shown:
                    continue
                shown = [("meshes, path-traced", images.reference_file(self.plan.out, scene, light))] + [
                    (m.name, images.picture_file(self.plan.out, scene, light, m)) for m in self.plan.methods
                    if f"picture/{scene.name}/{light.name}/{m.name}" in self.rows]
                shown = [(name, path) for name, path in shown if path.is_file()]
                if len(shown) > 1:
                    page.text(f"{scene.name}, {light.title}")
                    page.pictures([(name, images.load(path)[..., :3]) for name, path in shown], width=192)

    def _end(self, page: Page, failed: dict[str, str]) -> None:
        page.section("Lights and jobs")
        skies = [light for light in self.plan.lights[self.plan.scenes[0].name] if light.kind == "environment"]
        page.table(["environments"], [[light.title] for light in skies], folded=f"{len(skies)} environments")
        if failed:
            page.table(["failed job", "why"], sorted(failed.items()))

    def _built(self) -> dict[str, dict]:
        return {name.split("/")[1]: row for name, row in self.rows.items() if name.startswith("build/")}


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")


def _finish(*axes) -> None:
    for a in axes:
        plain(a)
        a.legend(frameon=False, labelcolor=GREY, fontsize=7)


def differences(sizes: Sizes, plan: Plan, machine: dict) -> list[str]:
    """What to know before ours and theirs are compared."""
    lights = plan.lights[plan.scenes[0].name]
    points = sum(light.kind == "point" for light in lights)
    stages = ", ".join(str(t.steps) for t in plan.stages())
    return [
        "Scenes are others: " + ", ".join(f"{s.name}" + (f" beside {s.paper}" if s.paper else "") for s in plan.scenes)
        + ". Levels cannot be compared, drops against NRF can.",
        f"Pictures: {sizes.pixels}² pixels, {points} point lights and {len(lights) - points} environments a scene "
        "[600², 400, 18]. Half of the point lights move alone, with the other half moves the camera; its light stands "
        "2 % farther away, since exactly at the camera no method is asked.",
        f"Brightness: a white surface facing a point light shines 1, environments have one mean radiance; each stands "
        f"as {sizes.cells} directional lights for the field, as it is for the meshes. rMSE is that of linear values; "
        "the paper does not say.",
        "Ground truth are the path-traced meshes with six edges a path; the field follows as many by radiosity. "
        f"{sizes.reference_spp} paths a pixel there, {sizes.spp[0]} and {sizes.spp[1]} samples here.",
        "The field is the shipped one in every column: feature planes learned in minutes, baked into voxels; the "
        "paper's are networks of 8 × 256 units trained with the transmittance for two days on four GPUs.",
        "TM reads the field's own network, which sees a ray's optical depths and has two logistics. AG, No AG and TM "
        f"of AG: the paper's kind, end points in and one logistic out, `--ntf {sizes.ntf}`, {sizes.steps} steps on the "
        f"finished field, {sizes.views} photographs of {sizes.photograph}² [670 000 steps, 500 of 600²]. NeRV: 4 × 128 "
        "units, trained beside AG.",
        f"Maps and volumes: {sizes.map_resolution}² texels a light [600²].",
        f"Transmittance curves: networks trained for {stages} steps each by itself, on a finished field.",
        "Times: " + ", ".join(f"{k} {v}" for k, v in machine.items()) + " [a GPU of 2018]. Map caches are off.",
        "The source of the paper holds its tables, but no numbers of its figures: circles are those of its table 1.",
    ]
