"""``none``: nothing casts or receives shadows."""

from types import ModuleType

from ..lights import LightTable
from .method import Keep, Medium, Method, Options


def build(medium: Medium, table: LightTable | None, options: Options, dj: ModuleType, keep: Keep) -> None:
    """Return None, which stands for no shadows."""


METHOD = Method(name="none", summary="no shadows", build=build, derivatives=True)
