"""Reflectance of a field as a scattering lobe (``nrf``, a phase function).

========= ==== ======= ===== ===========================================================================================
parameter type default range meaning
========= ==== ======= ===== ===========================================================================================
(none)                       the ``nrf`` medium creates its phase function by itself
========= ==== ======= ===== ===========================================================================================

Its value is f = ρ(R(x), ω_o, ω_i, n(x)) (⟨n,ω_i⟩ + ⟨n,ω_o⟩) in 1/sr and linear RGB, between directions on the side of
the normal, and less at grazing angles of curved skins. An opaque skin thus reflects like a surface of the microfacet
model ρ (:func:`mi_ntf.core.microfacet.scattering`). It is not normalised: its integral over directions is the albedo.
Smoke has the albedo times the phase function of Henyey and Greenstein (:mod:`mi_ntf.core.henyey_greenstein`) instead.
Stock ``volpath`` and ``volpathmis`` at `max_depth` 2 solve the same equation as the ``nrf`` integrator (Bi et al. 2020,
eq. 2).

Does not support: use outside an ``nrf`` medium; polarised and spectral variants; adjoint (importance) transport.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from ...infer import scatter
from ...infer.shade import Reflectance
from ...infer.types import Color3, Float, Mask, Vector, Vector3
from ..scene.frame import Frame

VOID = 1e-8
"""Density of samples that carry no light, 1/sr."""


def phase_class() -> type:
    """Return the plugin class for the current variant."""

    class NRFPhase(mi.PhaseFunction):
        __doc__ = __doc__

        frame: Frame
        reflectance: Callable[[Vector], Reflectance] | None = None

        def __init__(self, props: mi.Properties) -> None:
            mi.PhaseFunction.__init__(self, props)
            self.m_flags = int(mi.PhaseFunctionFlags.Anisotropic)

        def attach(self, frame: Frame, reflectance: Callable[[Vector], Reflectance]) -> None:
            """Set the placement of the medium, and the reflectance of its points."""
            self.frame, self.reflectance = frame, reflectance

        def _scattering(self, mei: mi.MediumInteraction3f) -> tuple[Vector, Reflectance]:
            """Return the direction to the viewer, field coordinates, and the reflectance."""
            if self.reflectance is None:
                raise MiNtfError("phase function nrf stands alone; remove it: the nrf medium creates its own")
            return self.frame.direction_to_field(mei.wi), self.reflectance(self.frame.point_to_field(mei.p))

        def eval_pdf(self, ctx: mi.PhaseFunctionContext, mei: mi.MediumInteraction3f, wo: Vector3, active: Mask = True
                     ) -> tuple[Color3, Float]:
            viewer, reflectance = self._scattering(mei)
            value, pdf = scatter.evaluate(self.frame.direction_to_field(wo), viewer, reflectance)
            return mi.Spectrum(value), pdf

        def sample(self, ctx: mi.PhaseFunctionContext, mei: mi.MediumInteraction3f, sample1: Float, sample2: Vector3,
                   active: Mask = True) -> tuple[Vector3, Color3, Float]:
            viewer, reflectance = self._scattering(mei)
            light = scatter.sample(viewer, reflectance, sample1, (sample2.x, sample2.y))
            value, pdf = scatter.evaluate(light, viewer, reflectance)
            weight: Color3 = mi.Spectrum(value) * dr.select(active & (pdf > VOID), dr.rcp(pdf), 0)
            # With density 0 a void sample would not end the path: volpath and prbvolpath would continue unscattered.
            return self.frame.direction_to_world(light), weight, dr.maximum(pdf, VOID)

        def to_string(self) -> str:
            return "NRFPhase[]"

    return NRFPhase
