"""The README and the pages say what is true: their code runs, their links lead somewhere, every name is documented."""

import importlib
import importlib.util
import inspect
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from prose import assert_fit_to_read

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").rglob("*.md"))]
TEXTS = [*PAGES, *(ROOT / name for name in ("CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff", "mkdocs.yml"))]
PARTS = ["viewer", "tuning", "scaling", "retargeting", "reachability", "calibration", "placement"]
PACKAGES = [*PARTS, "runtime", "solvers", "schemes", "physics", "interop.ros2"]
PACKAGES = ("osik_jax", *(f"osik_jax.{part}" for part in PACKAGES))
OPTIONAL = ["matplotlib", "tyro", "rich", "torch", "pinocchio", "cyclonedds", "mink", "optax"]
OPTIONAL += [f"osik_jax.{part}" for part in (*PARTS, "interop", "demo")]

BLOCK = re.compile(r"^```python(?: title=\"([\w-]+)\")?\n(.*?)^```", re.MULTILINE | re.DOTALL)
"""A block's title may be one of ``LIBRARIES``; the block runs where that is installed."""
LIBRARIES = ("mink", "pinocchio", "flatbuffers", "torch", "gymnasium")
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
REPOSITORY = "https://github.com/osik-jax/osik-jax"
IN_REPOSITORY = re.compile(  # as a package index shows the README, its links have to be whole
    rf"(?:{REPOSITORY}/(?:blob|tree)|https://raw\.githubusercontent\.com/osik-jax/osik-jax)/main/"
)
NAMED = re.compile(r"^::: (\S+)$", re.MULTILINE)


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


def public_names(package: str) -> dict[str, Any]:
    """What a package offers: names without an underscore that are not modules."""
    found = vars(importlib.import_module(package))
    return {k: v for k, v in found.items() if not k.startswith("_") and not inspect.ismodule(v) and k != "annotations"}


def resolve(path: str) -> Any:
    package, _, name = path.rpartition(".")
    return getattr(importlib.import_module(package), name)


def own_docstring(value: Any) -> str:
    """Not what a class inherits, nor the signature that dataclasses make up."""
    text = (vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__) or ""
    return "" if text.startswith(f"{value.__name__}(") else text.strip()


def heading_anchors(page: Path) -> set[str]:
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


WITH_CODE = {relative(page): page for page in PAGES if BLOCK.search(page.read_text())}
IN_THE_GATE = ["the_loop", "conventions", "robots", "choosing_a_scheme", "deploying", "own_task"]
IN_THE_GATE += ["reinforcement_learning", "porting"]
IN_THE_GATE = [f"docs/{page}.md" for page in IN_THE_GATE]
QUICK = ["README.md", "docs/index.md", "docs/installation.md", "docs/physics.md", "docs/traced_vs_static.md"]


@pytest.mark.variants(ordinary=QUICK, slow=IN_THE_GATE)
@pytest.mark.parametrize("page", WITH_CODE.values(), ids=WITH_CODE)
def test_code_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = page.read_text()
    monkeypatch.chdir(tmp_path)  # for the files that a page writes
    namespace: dict[str, Any] = {"__name__": "documentation"}
    for block in BLOCK.finditer(text):
        title, code = block.groups()
        if title in LIBRARIES and importlib.util.find_spec(title) is None:
            continue
        line = text[: block.start(2)].count("\n")
        exec(compile("\n" * line + code, str(page), "exec"), namespace)
    if page == README:
        assert capsys.readouterr().out.startswith("True [")
        assert namespace["found"].converged
        assert abs(namespace["step"].error["hand"]).max() < 1e-4  # metres, after two seconds
        assert max(abs(namespace["step"].error[name]).max() for name in ("left foot", "right foot")) < 1e-4


def assert_leads_somewhere(target: str, page: Path) -> None:
    """A link to a file of the repository, from a page or as a whole address; others are not followed."""
    inside, count = IN_REPOSITORY.subn("", target, count=1)
    if re.match(r"[a-z]+:", inside):
        return
    path, _, anchor = inside.partition("#")
    there = ((ROOT if count else page.parent) / path).resolve() if path else page
    assert there.exists(), f"{target} does not exist"
    if anchor:
        assert anchor in heading_anchors(there), f"{target}: no such heading"


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=relative)
def test_links_lead_somewhere(page: Path) -> None:
    for target in LINK.findall(page.read_text()):
        assert_leads_somewhere(target, page)


def test_readme_is_a_page_of_a_package_index_too() -> None:
    """Which knows nothing of the files beside it: every address is whole, and pictures are the files themselves."""
    text = README.read_text()
    assert [target for target in LINK.findall(text) if not target.startswith("https://")] == []
    for picture in re.findall(r"!\[[^\]]*\]\(([^)\s]+)\)", text):
        assert picture.startswith(("https://raw.githubusercontent.com/", "https://colab.research.google.com/assets/"))


@pytest.mark.parametrize("text", TEXTS, ids=relative)
def test_nothing_is_unfinished(text: Path) -> None:
    content = text.read_text()
    assert_fit_to_read(content)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_has_a_docstring(package: str) -> None:
    code = {k: v for k, v in public_names(package).items() if inspect.isclass(v) or inspect.isfunction(v)}
    assert code
    bare = [name for name, value in code.items() if not own_docstring(value)]
    bare += [
        f"{name}.{method}"
        for name, value in code.items()
        if inspect.isclass(value)
        for method, member in vars(value).items()
        if inspect.isfunction(member) and not method.startswith("_") and not own_docstring(member)
    ]
    assert not bare


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_in_the_reference(package: str) -> None:
    paths = NAMED.findall((ROOT / "docs" / "api.md").read_text())
    documented = [resolve(path) for path in paths]
    missing = [
        name
        for name, value in public_names(package).items()
        if f"{package}.{name}" not in paths and not any(value is other for other in documented)
    ]
    assert not missing
    assert len(paths) == len({id(value) for value in documented})


def test_every_page_is_in_the_navigation() -> None:
    navigation = re.findall(r"^\s+- .*?([\w]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert sorted(navigation) == sorted(page.name for page in PAGES if page != README)


def test_one_version_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {project['version']}\n" in citation
    assert f"\nlicense: {project['license']}\n" in citation
    assert project["version"] in (ROOT / "CHANGELOG.md").read_text()


def test_extras_are_installed_from_a_checkout_and_exist() -> None:
    """The package is on no index: ``pip install ".[extra]"`` is the one form, in pages, messages and docstrings."""
    code = [path for part in ("osik_jax", "examples", "notebooks") for path in (ROOT / part).rglob("*.py")]
    texts = {path: path.read_text() for path in (*TEXTS, *code)}
    assert [path.name for path, text in texts.items() if re.search(r"osik[-_]jax\[\w", text)] == []
    asked = [names for text in texts.values() for names in re.findall(r'"\.\[([\w, ]+)\]"', text)]
    asked += [name for text in texts.values() for name in re.findall(r'missing_extra\(.*, "(\w+)"\)', text)]
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert len(asked) > 15 and {name.strip() for names in asked for name in names.split(",")} <= set(extras)


def test_import_is_light() -> None:
    code = f"import osik_jax, sys; print(*(m for m in {OPTIONAL!r} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.splitlines()[-1:] in ([], [""])
