"""Run all examples and write their pictures, made small, for docs/gallery.md: python -m examples [NAME ...]."""

import argparse
import os
import runpy
import tempfile
from pathlib import Path

import matplotlib
from PIL import Image

from osik_jax.runtime import configure_cpu

FOLDER = Path(__file__).parent
PICTURES = FOLDER.parent / "docs" / "images" / "examples"
NAMES = sorted(path.stem for path in FOLDER.glob("[!_]*.py"))
WIDTH = 900
"""Width of a picture of the gallery [pixels]."""
MOST_BYTES = 60_000
"""Size of a picture of the gallery [bytes]."""


def run(name: str, folder: Path) -> Path:
    """Run an example in a folder, and return the picture that it writes there."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        runpy.run_path(str(FOLDER / f"{name}.py"))
    finally:
        os.chdir(before)
    return folder / f"{name}.png"


def shrink(picture: Path, out: Path) -> int:
    """Write the picture ``WIDTH`` pixels wide, in as many colours as ``MOST_BYTES`` allows; return its size [bytes]."""
    with Image.open(picture) as image:
        small = image.convert("RGB").resize(
            (WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS
        )
    for colors in (256, 128, 96, 64, 48, 32, 24):
        small.quantize(colors, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(out, optimize=True)
        if out.stat().st_size <= MOST_BYTES:
            break
    return out.stat().st_size


def main() -> None:
    """Run the examples that are named, or all of them."""
    parser = argparse.ArgumentParser(prog="python -m examples", description=__doc__)
    parser.add_argument("names", nargs="*", default=NAMES, metavar="NAME")
    matplotlib.use("Agg")
    configure_cpu()
    PICTURES.mkdir(parents=True, exist_ok=True)
    for name in parser.parse_args().names:
        print(f"\n== {name}")
        with tempfile.TemporaryDirectory() as folder:
            size = shrink(run(name, Path(folder)), PICTURES / f"{name}.png")
        print(f"{PICTURES / name}.png: {size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
