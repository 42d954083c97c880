"""Configuration of Sphinx for `docs/site/build.py`."""

project = "CarAware"
root_doc = "README"
extensions = ["myst_parser"]
html_theme = "furo"
html_title = "CarAware"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
html_theme_options = {"navigation_with_keys": True}
# Headings get the anchors that GitHub gives them.
myst_heading_anchors = 6
# Blocks may leave out what does not matter there (…), which a highlighter does not understand.
suppress_warnings = ["misc.highlighting_failure"]
