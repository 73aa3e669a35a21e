"""The documentation site: `python -m sphinx -W docs docs/_build`; its pictures are drawn by the examples meanwhile."""

import builtins
import re
import shutil
import sys
from importlib import metadata
from pathlib import Path

from jinja2 import PackageLoader
from jinja2.sandbox import SandboxedEnvironment
from numpydoc import docscrape, docscrape_sphinx, numpydoc
from sphinx.application import Sphinx
from sphinx.util import logging

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import file_reference  # noqa: E402
import variable_reference  # noqa: E402

project = "cycloid-fmu"
author = "the cycloid-fmu developers"
version = release = metadata.version("cycloid-fmu")

templates_path = ["_templates"]
extensions = [
    "myst_parser",
    "sphinx-mathjax-offline",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_gallery.gen_gallery",
    "sphinxcontrib.typer",
]
root_doc = "index"
exclude_patterns = ["_build", "generated/examples"]
html_theme = "pydata_sphinx_theme"
html_theme_options = {
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "header_links_before_dropdown": 6,
    "secondary_sidebar_items": {"**": ["page-toc"], "generated/variables": [], "development/benchmarks": []},
}
html_sidebars = {"index": [], "install": []}
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = "cycloid-fmu"
html_show_sourcelink = False

myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
# A single pair of backticks in a docstring names something of the package, a standard or a file.
default_role = "autolink"
numpydoc_show_class_members = False
numpydoc_xref_param_type = False
autosummary_generate = True
autodoc_typehints = "none"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True, "member-order": "bysource", "exclude-members": "model_config"}
autodoc_inherit_docstrings = False
# The gallery's settings hold a function, so Sphinx reads them again each time.
suppress_warnings = ["config.cache"]

# numpydoc compiles its template again for every docstring, which takes a sixth of the time of a build.
TEMPLATE = SandboxedEnvironment(loader=PackageLoader("numpydoc")).get_template("numpydoc_docstring.rst")


def documented(
    obj: object, what: str | None = None, doc: str | None = None, config: dict | None = None, builder: object = None
) -> docscrape.NumpyDocString:
    """Return the docstring of an object as numpydoc does, with the one template."""
    return docscrape.get_doc_object(
        obj,
        what,
        doc,
        {**(config or {}), "template": TEMPLATE},
        docscrape_sphinx.SphinxClassDoc,
        docscrape_sphinx.SphinxFunctionDoc,
        docscrape_sphinx.SphinxObjDoc,
    )


EXAMPLES = HERE / "generated" / "examples"


def fresh_examples() -> None:
    """Copy the examples to where what they write does no harm, and take away the pages of those that are gone."""
    shutil.rmtree(EXAMPLES, ignore_errors=True)
    for page in (HERE / "gallery").glob("*.rst"):
        if not (HERE.parent / "examples" / f"{page.stem}.py").exists():
            page.unlink()
    shutil.copytree(HERE.parent / "examples", EXAMPLES, ignore=shutil.ignore_patterns("__pycache__", "*_out"))
    (EXAMPLES / "GALLERY_HEADER.rst").write_text(
        "Gallery\n=======\n\nEvery picture and every number below was made by the example while this site was built.\n",
        encoding="utf-8",
    )


def pictures(block: tuple, block_variables: dict, gallery: dict) -> str:
    """Take the pictures that an example wrote since the last block: they are drawn without a screen."""
    from sphinx_gallery.scrapers import figure_rst

    images = []
    for found in sorted(EXAMPLES.rglob("*.png")):
        images.append(next(block_variables["image_path_iterator"]))
        shutil.move(found, images[-1])
    return figure_rst(images, gallery["src_dir"])


def named(gallery: dict, file: str) -> None:
    """Set an example's own path, which the gallery does not: the example looks for its files beside itself."""
    builtins.__file__ = str(EXAMPLES / file)


fresh_examples()
file_reference.write(file_reference.PAGE)
variable_reference.write(HERE / "generated" / "variables.md")
sphinx_gallery_conf = {
    "examples_dirs": "generated/examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"\.py$",
    "ignore_pattern": "joint_parts",  # what the joint package imports
    "image_scrapers": (pictures,),
    "reset_modules": (named,),
    "matplotlib_animations": False,
    "within_subsection_order": "FileNameSortKey",
    "capture_repr": (),
    "remove_config_comments": True,
    "show_memory": False,
    "write_computation_times": False,  # its page loads scripts from the network
    "min_reported_time": 1e9,
    "abort_on_example_error": True,
    "line_numbers": False,
    "copyfile_regex": r".*\.(toml|csv)$",
}


def without_substitutions(app: object, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Docstrings write |x| for the absolute value, which is a substitution in reStructuredText."""
    lines[:] = [line.replace("|", "\\|") for line in lines]


def without_network(app: Sphinx, problem: Exception | None) -> None:
    """Warn of a page that loads a script, style or picture from the network: the site is read offline too."""
    loads = re.compile(r"""<(?:script|img|iframe|link[^>]+stylesheet)[^>]+(?:src|href)=["'](?:https?:)?//""")
    for page in [] if problem else Path(app.outdir).rglob("*.html"):
        if loads.search(page.read_text(encoding="utf-8")):
            logging.getLogger(__name__).warning("%s loads something from the network", page)


def setup(app: Sphinx) -> None:
    """Set up numpydoc with `documented`, and the functions above."""
    numpydoc.setup(app, documented)
    app.connect("autodoc-process-docstring", without_substitutions)
    app.connect("build-finished", without_network)
