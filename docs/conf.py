"""Configuration of the documentation site: `make docs` builds it into out/docs without a network."""

from mi_ntf import __version__

project = "mi_ntf"
author = "the mi_ntf authors"
project_copyright = author
release = version = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
highlight_language = "none"
html_theme = "furo"
html_title = f"mi_ntf {release}"
html_show_sphinx = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"footer_icons": []}

myst_heading_anchors = 3
napoleon_use_ivar = True
myst_enable_extensions = ["deflist", "dollarmath"]

nb_execution_mode = "force"
nb_execution_timeout = 120  # kernels are compiled at the first build; a later one takes at most 30 s a notebook
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_class_signature = "separated"
autodoc_typehints = "description"
