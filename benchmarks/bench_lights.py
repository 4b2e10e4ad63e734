"""Errors of maps and atlas under one light at a time: those of many lights cancel in their sum."""

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf.core import spheres
from mi_ntf.evaluate import metrics
from mi_ntf.infer import march, shade
from mi_ntf.infer.bundle import Strand
from mi_ntf.infer.visibility import raymarch
from mi_ntf.render.maps import building

from .bench_measure import Row, Sizes, row
from .bench_paper import view_rays
from .loops import table_of

STEP, FINE = 2 / 384, 2 / 1536
"""Cells of the camera's march and of the atlas; those that light's march, and maps, are made with."""


class Picture:
    """Shading points of the field that the camera of `scene` sees, and their weights: `side`² pixels of four rays."""

    def __init__(self, scene, medium, side: int):
        o, d, far = view_rays(scene.sensors()[0], medium.frame, 2 * side)
        rng = np.random.default_rng(0)
        offset, depth = (mi.Float(rng.random(4 * side**2, np.float32)) for _ in range(2))
        found = march.camera_samples([Strand(medium.field.grid, o, d, dr.opaque(mi.Float, STEP))], far, offset, depth)
        x, along = found.place(0, found.ray, found.t)
        self._found, self._side = found, side
        self._points = shade.Points(x, tuple(-c for c in along), medium.reflectance(x))
        self._points.evaluate()

    def images(self, table, visibility) -> list[np.ndarray]:
        """Radiance, (pixels, 3), under each light of `table` alone."""
        lights = [_One(table, visibility, k) for k in range(table.count)]
        return [self.image(light, light) for light in lights]

    def image(self, table, visibility) -> np.ndarray:
        """Radiance, (pixels, 3), under all lights of `table`."""
        values = shade.reflect(self._points, table, visibility)
        weighted = [c * self._found.weights[0] for c in values]
        dr.eval(weighted)
        rays = np.array(self._found.totals(weighted)).T.reshape(self._side, 2, self._side, 2, 3)
        return rays.mean((1, 3)).reshape(-1, 3)


class _One:
    """Light `k` of a table, as a table and a visibility of one light."""

    count = 1

    def __init__(self, table, visibility, k: int):
        self._table, self._visibility, self._k = table, visibility, dr.opaque(mi.UInt32, k)

    def sample(self, index, x, active):
        return self._table.sample(index + self._k, x, active)

    def tau(self, x, wi, distance, index, active):
        return self._visibility.tau(x, wi, distance, index + self._k, active)


def rows(scene, medium, sizes: Sizes) -> list[Row]:
    """Relative RMSE of the sum of some lights, and of each light's own image: mean and worst. Against a march of steps
    of 1/768 on the same shading points, so that the light's transmittance is all that differs."""
    picture, table = Picture(scene, medium, sizes.error_image), table_of(spheres.fibonacci(sizes.single_lights))
    truth = picture.images(table, raymarch.build(medium, table, building.Options(FINE), mi, None))
    lit = [i for i, image in enumerate(truth) if image.any()]
    methods = {f"map_source=field, {sizes.error_map}², {text}":
               ("transmittance_map", building.Options(FINE, sizes.error_map, map_components=n))
               for n, text in ((1, "logistic"), (2, "mixture"))}
    methods["transmittance_atlas"] = "transmittance_atlas", building.Options(STEP)
    result, count = [], table.count
    for kind, (name, options) in methods.items():
        images = picture.images(table, building.build(name, medium, table, options))
        each = [100 * metrics.relative_rmse(images[i], truth[i]) for i in lit] or [0.0]
        whole = 100 * metrics.relative_rmse(np.sum(images, 0), np.sum(truth, 0)) if lit else 0.0
        details = {"sum": whole, "each": each, "side": sizes.error_image, "dark_lights": count - len(lit)}
        what = f"{kind}, relative RMSE to a march on the same points, "
        result += [row(f"{what}sum of {count} lights", whole, "%", details=details),
                   row(f"{what}each of {count} lights alone, mean", float(np.mean(each)), "%", details=details),
                   row(f"{what}each of {count} lights alone, worst", max(each), "%", details=details)]
    return result
