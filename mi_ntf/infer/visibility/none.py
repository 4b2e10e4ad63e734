"""``none``: nothing casts or receives shadows."""

from .method import Method

METHOD = Method(
    name="none",
    summary="no shadows",
    build=lambda medium, table, options, dj, keep: None,
    derivatives=True,
)
