"""The notebooks run, in their fast mode, and beside each lies what it gives when it is run in full."""

import re
from pathlib import Path
from typing import Any

import jax
import jupytext
import matplotlib
import matplotlib.pyplot as plt
import nbformat
import pytest
from nbconvert import HTMLExporter
from prose import assert_fit_to_read

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "notebooks").glob("*.py"))
PAGE = ROOT / "docs" / "notebooks.md"

MOST_BYTES = 1_200_000

each_notebook = pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)


def executed(source: Path) -> Any:
    return nbformat.read(source.with_suffix(".ipynb"), as_version=4)


def code_cells(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def outputs(notebook: Any) -> list[Any]:
    return [output for cell in code_cells(notebook) for output in cell.outputs]


def shown_text(output: Any) -> str:
    text = output.get("text", "") + "".join(v for k, v in output.get("data", {}).items() if k.startswith("text/"))
    return re.sub(r"base64,[\w+/=]+", "", text)  # pictures inside a page


@pytest.mark.variants(release=[path.stem for path in SOURCES[1:]])
@pytest.mark.slow
@each_notebook
def test_runs_in_fast_mode(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OSIK_FAST", "1")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.chdir(source.parent)  # as Jupyter does
    matplotlib.use("Agg")
    files = sorted(source.parent.iterdir())
    try:
        exec(compile(source.read_text(), str(source), "exec"), {"__name__": "notebook"})
        assert plt.get_fignums()
    finally:
        plt.close("all")
        jax.config.update("jax_disable_most_optimizations", False)
        jax.clear_caches()
    assert sorted(source.parent.iterdir()) == files


@each_notebook
def test_what_was_executed_is_the_source(source: Path) -> None:
    wanted, there = jupytext.read(source), executed(source)
    assert [(cell.cell_type, cell.source) for cell in there.cells] == [
        (cell.cell_type, cell.source) for cell in wanted.cells
    ]
    cells = code_cells(there)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))


@each_notebook
def test_outputs_are_clean_and_have_figures(source: Path) -> None:
    everything = outputs(executed(source))
    assert not [output for output in everything if output.output_type == "error"]
    assert not [output.text for output in everything if output.get("name") == "stderr"]
    assert [output for output in everything if "image/png" in output.get("data", {})]
    assert source.with_suffix(".ipynb").stat().st_size < MOST_BYTES


@each_notebook
def test_nbconvert_shows_every_output(source: Path) -> None:
    shown = set(HTMLExporter().config.NbConvertBase.display_data_priority) - {"text/plain"}
    hidden = [output.data for output in outputs(executed(source)) if "data" in output and not shown & set(output.data)]
    assert [data for data in hidden if set(data) != {"text/plain"}] == []


@each_notebook
def test_text_is_fit_to_read(source: Path) -> None:
    notebook = executed(source)
    text = "\n".join([*(cell.source for cell in notebook.cells), *map(shown_text, outputs(notebook))])
    assert_fit_to_read(text)
    first = notebook.cells[0]
    assert first.cell_type == "markdown"
    assert first.source.startswith("# ")
    assert "After this notebook you can" in first.source


def test_there_are_notebooks_and_each_is_on_their_page() -> None:
    assert SOURCES[0].stem == "1_quickstart"
    assert [path.stem for path in sorted(SOURCES[0].parent.glob("*.ipynb"))] == [path.stem for path in SOURCES]
    assert set(re.findall(r"`(\d_\w+)`", PAGE.read_text())) == {path.stem for path in SOURCES}
