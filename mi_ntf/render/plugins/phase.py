"""The ``nrf`` phase function."""

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from ...infer import scatter

VOID = 1e-8
"""Density of samples that carry no light, 1/sr."""


def phase_class() -> type:
    """The plugin class for the current variant."""

    class NRFPhase(mi.PhaseFunction):
        """Reflectance of a field as a scattering lobe (``nrf``).

        =========== ====== ===================================================================
        parameter   type   meaning
        =========== ====== ===================================================================
        (none)             the ``nrf`` medium creates its phase function by itself
        =========== ====== ===================================================================

        Value: f = ρ(R(x), ω_o, ω_i, n(x)) (⟨n,ω_i⟩ + ⟨n,ω_o⟩), less at grazing angles of curved skins, between
        directions on the normal's side, linear RGB, 1/sr, which makes an opaque skin reflect like a surface of the
        microfacet ρ (:func:`mi_ntf.core.microfacet.scattering`). Its integral is no probability. Stock ``volpath`` and
        ``volpathmis`` at `max_depth` 2 solve the same equation as the ``nrf`` integrator (Bi et al. 2020, eq. 2).

        Does not support: use outside an ``nrf`` medium; polarised and spectral variants; adjoint (importance)
        transport.
        """

        def __init__(self, props):
            mi.PhaseFunction.__init__(self, props)
            self.frame, self.reflectance = None, None
            self.m_flags = int(mi.PhaseFunctionFlags.Anisotropic)

        def attach(self, frame, reflectance):
            """Called by the medium: its placement, and what it reflects at a point."""
            self.frame, self.reflectance = frame, reflectance

        def _look(self, mei):
            if self.reflectance is None:
                raise MiNtfError("phase function nrf stands alone; remove it: the nrf medium creates its own")
            return (self.frame.direction_to_field(mei.wi), self.reflectance(self.frame.point_to_field(mei.p)))

        def eval_pdf(self, ctx, mei, wo, active=True):
            viewer, reflectance = self._look(mei)
            value, pdf = scatter.evaluate(self.frame.direction_to_field(wo), viewer, reflectance)
            return mi.Spectrum(value), pdf

        def sample(self, ctx, mei, sample1, sample2, active=True):
            viewer, reflectance = self._look(mei)
            light = scatter.sample(viewer, reflectance, sample1, (sample2.x, sample2.y))
            value, pdf = scatter.evaluate(light, viewer, reflectance)
            weight = mi.Spectrum(value) * dr.select(active & (pdf > VOID), dr.rcp(pdf), 0)
            # Of density 0 a void sample would not end the path: volpath and prbvolpath then go straight on unscattered.
            return self.frame.direction_to_world(light), weight, dr.maximum(pdf, VOID)

        def to_string(self):
            return "NRFPhase[]"

    return NRFPhase
