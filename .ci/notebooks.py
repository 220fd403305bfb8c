"""Executed notebooks as pages of the site: /notebooks/1_quickstart.html and so on, made by nbconvert."""

from __future__ import annotations

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbconvert import HTMLExporter

_FOLDER = Path(__file__).parent.parent / "notebooks"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each notebook; mkdocs calls this once the folder of pages is read."""
    for notebook in sorted(_FOLDER.glob("*.ipynb")):
        page, _ = HTMLExporter().from_filename(str(notebook))
        files.append(File.generated(config, f"notebooks/{notebook.stem}.html", content=page))
    return files
