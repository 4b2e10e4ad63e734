"""Header of a field file: the networks' shapes, the similarity transform and the provenance.

A field has three or four networks, each an encoding followed by a ReLU multilayer perceptron:

    density        x → 1        raw; σ = exp(raw), see :data:`MAX_LOG_DENSITY`; 1/(unit-sphere radius)
    reflectance    x → 7 + c    raw normal (3), albedo (3), roughness (1), specular weight (c = 1 or 3, a colour)
    transmittance  ray → 3K−1   raw (a, b) of K logistics, then K−1 weights; :mod:`mi_ntf.core.mixture`
    visibility     x, ω → 1     raw τ, through a sigmoid, of the ray from x towards the light; optional

The third network reads a ray as its optical depths (encoding `depth`, :mod:`mi_ntf.core.depth_profile`) or, as in the
paper, as its end points p1 and p2 (encoding `frequency` of the six coordinates). The fourth is the baseline, NeRV's
(Srinivasan et al. 2021): one query for each point and direction, with τ not monotone along a ray.
"""

from dataclasses import asdict, dataclass, field
from itertools import pairwise

from .depth_profile import FEATURES
from .errors import MiNtfError, shown
from .fresnel import DIELECTRIC
from .json_values import Json, member, number, whole

FORMAT = 2
KEY = "mi_ntf"
"""Name of the header in the metadata of a field file."""
MAX_LOG_DENSITY = 6.5
"""Upper bound of ln σ: σ ≤ 665 per unit-sphere radius, a skin of 0.0015 radii."""
MIN_LOG_DENSITY = -12.0
"""Lower bound of ln σ."""
LOG_FLOOR = -6.0
"""Lower bound of ln σ where it is interpolated in space. Lower values are as empty, but would thin out a skin beside
them."""
MAX_OCTAVES = 24
"""Largest number of octaves: sin(2^k π x) of higher k is noise in single precision."""
RETRO, TAIL = "reflectance.retro", "reflectance.tail"
"""Names of the tensors of the retro-reflection and of the tail of the specular lobe."""
NAMES = ("density", "reflectance", "transmittance")
"""Networks of every field."""

NO_VISIBILITY = "the field has no visibility network; train it with `mi-ntf train --visibility-mlp`"


@dataclass(frozen=True)
class Encoding:
    """Features that a network reads.

    Kind ``planes``: for each resolution three feature planes (x,y), (x,z), (y,z) of `channels` features, multiplied
    elementwise. ``frequency``: x, sin(2^k π x), cos(2^k π x) for k < octaves. ``depth``: ``depth_profile.features`` of
    rays.
    """

    kind: str
    resolutions: tuple[int, ...] = ()
    channels: int = 0
    octaves: int = 0

    def width(self, coordinates: int = 3) -> int:
        """Return the number of features of so many `coordinates`."""
        if self.kind == "depth":
            return FEATURES
        planes = len(self.resolutions) * self.channels
        return planes if self.kind == "planes" else coordinates * (1 + 2 * self.octaves)


@dataclass(frozen=True)
class Network:
    """Shape of a network; `hidden`: widths of its hidden layers."""

    encoding: Encoding
    hidden: tuple[int, ...]
    components: int = 1
    """Logistics of a ray; 1 for the other networks."""

    def inputs(self, name: str) -> int:
        """Return the number of inputs of the network called `name`."""
        return self.encoding.width(6 if name in ("transmittance", "visibility") else 3)

    def outputs(self, name: str, specular_channels: int = 1) -> int:
        """Return the number of outputs of the network called `name`."""
        return {"density": 1, "reflectance": 7 + specular_channels, "transmittance": 3 * self.components - 1,
                "visibility": 1}[name]


@dataclass(frozen=True)
class Architecture:
    """Shapes of the networks of a field."""

    density: Network
    reflectance: Network
    transmittance: Network
    visibility: Network | None = None
    fresnel: bool = False
    """True if the specular weight is the reflectance at normal incidence of :mod:`mi_ntf.core.fresnel`."""
    retro: bool = False
    """True if the file has the retro-reflection of :mod:`mi_ntf.core.fresnel`, as the tensor RETRO of one raw number,
    through a sigmoid."""
    tail: bool = False
    """True if the file has the tail of :mod:`mi_ntf.core.microfacet`, as the tensor TAIL of one raw number, through a
    sigmoid."""
    phase: float | None = None
    """Asymmetry g of smoke, which scatters by :mod:`mi_ntf.core.henyey_greenstein`; None: a surface's reflectance.
    Smoke has no normal and no specular lobe: the reflectance network's albedo alone counts."""
    specular_channels: int = 1
    """Channels of the specular weight: 3 for linear RGB, as metals need it; 1 for a grey one."""

    @property
    def least_specular(self) -> float:
        """Lower bound of the reflectance network's specular weight."""
        return DIELECTRIC if self.fresnel else 0.0

    def networks(self) -> dict[str, Network]:
        """Return name → network of all networks of the field."""
        optional = {} if self.visibility is None else {"visibility": self.visibility}
        return {name: getattr(self, name) for name in NAMES} | optional

    def skeleton(self) -> dict[str, tuple[int, ...]]:
        """Return name → shape of every tensor of the file: layers (outputs, inputs), planes (3, v, u, channels)."""
        shapes: dict[str, tuple[int, ...]] = {}
        for name, net in self.networks().items():
            if net.encoding.kind == "planes":
                for i, r in enumerate(net.encoding.resolutions):
                    shapes[f"{name}.planes.{i}"] = (3, r, r, net.encoding.channels)
            sizes = [net.inputs(name), *net.hidden, net.outputs(name, self.specular_channels)]
            for i, (n_in, n_out) in enumerate(pairwise(sizes)):
                shapes[f"{name}.layers.{i}.weight"] = (n_out, n_in)
                shapes[f"{name}.layers.{i}.bias"] = (n_out,)
        return shapes | ({RETRO: (1,)} if self.retro else {}) | ({TAIL: (1,)} if self.tail else {})


@dataclass(frozen=True)
class Similarity:
    """Transform to field coordinates: field = (world − center)/radius, lengths in scene units of the capture."""

    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 1.0


@dataclass(frozen=True)
class Header:
    """Contents of a field file apart from its tensors; `provenance`: free-form JSON about the training."""

    architecture: Architecture
    similarity: Similarity = Similarity()
    provenance: Json = field(default_factory=dict)

    def to_json(self) -> Json:
        """Return the header as JSON."""
        return {"format": FORMAT} | asdict(self)


def header_from_json(data: object, source: str) -> Header:
    """Parse and check a header, any JSON; raise MiNtfError, whose text begins with `source` (a file name)."""
    version = data.get("format") if isinstance(data, dict) else None
    if not isinstance(data, dict) or version != FORMAT:
        raise MiNtfError(f"{source}: field format {shown(version)}, this build reads {FORMAT}; "
                         "train or export the field anew")
    try:
        described = member(data, "architecture", dict)
        nets = {name: _network(member(described, name, dict), name) for name in NAMES}
        if described.get("visibility") is not None:  # absent from files of earlier builds
            nets["visibility"] = _network(member(described, "visibility", dict), "visibility")
        fresnel, retro, tail = (member({name: False} | described, name, bool) for name in ("fresnel", "retro", "tail"))
        phase = described.get("phase")  # likewise
        if phase is not None and not abs(number(phase, "the asymmetry of the phase function")) < 1:
            raise ValueError(f"the asymmetry of the phase function is {shown(phase)}, expected -1 to 1, exclusive")
        channels = described.get("specular_channels", 1)  # likewise
        if channels not in (1, 3) or isinstance(channels, bool):
            raise ValueError(f"the specular weight has {shown(channels)} channels, expected 1 or 3")
        similarity = member(data, "similarity", dict)
        center = member(similarity, "center", list)
        if len(center) != 3:
            raise ValueError(f"the similarity's center {shown(center)}, expected 3 numbers")
        x, y, z = (number(c, "the similarity's center") for c in center)
        radius = number(member(similarity, "radius", object), "the similarity's radius", above=0)
        provenance = member({"provenance": {}} | data, "provenance", dict)
        architecture = Architecture(**nets, fresnel=fresnel, retro=retro, tail=tail, phase=phase,
                                    specular_channels=int(channels))
        return Header(architecture, Similarity((x, y, z), radius), provenance)
    except ValueError as error:
        raise MiNtfError(f"{source}: the header's description is incomplete or wrong: {error}; "
                         "was it written by `mi-ntf train`?") from None


def _network(data: Json, name: str) -> Network:
    legal = {"transmittance": ("frequency", "depth"), "visibility": ("frequency",)}.get(name, ("planes", "frequency"))
    e = member(data, "encoding", dict)
    kind = member(e, "kind", str)
    if kind not in legal:
        raise ValueError(f"encoding kind {shown(kind)} of {name}, expected one of {', '.join(legal)}")
    planes = kind == "planes"
    resolutions = tuple(whole(r, f"a resolution of {name}", 2) for r in member(e, "resolutions", list))
    if planes != bool(resolutions):
        raise ValueError(f"{len(resolutions)} resolutions of {name}, whose encoding is {kind}; planes alone have any")
    channels = whole(member(e, "channels", object), f"channels of {name}", int(planes))
    octaves = whole(member(e, "octaves", object), f"octaves of {name}", 0, MAX_OCTAVES)
    hidden = tuple(whole(n, f"a layer's width in {name}", 1) for n in member(data, "hidden", list))
    components = whole(member(data, "components", object), f"components of {name}", 1)
    return Network(Encoding(kind, resolutions, channels, octaves), hidden, components)


FAST = Architecture(
    density=Network(Encoding("planes", (64, 192), 8), (32,)),
    reflectance=Network(Encoding("planes", (48, 128), 10), (64,)),
    transmittance=Network(Encoding("depth"), (32, 32), components=2),
)
"""Sizes that train in minutes on two CPU cores: 12 bilinear fetches per sample and small perceptrons."""

_PAPER = Network(Encoding("frequency", octaves=10), (256,) * 8)
PAPER = Architecture(density=_PAPER, reflectance=_PAPER, transmittance=_PAPER)
"""The sizes of Shafiei et al. 2021: 8 layers of 256 units on 10 octaves, one logistic from the two end
points of a ray. Density and reflectance, one network in the paper, are two, as in every field file, and no layer sees
the encoding again."""

VISIBILITY = Network(Encoding("frequency", octaves=6), (128,) * 4)
"""The network `visibility` of fields that are trained with it."""
