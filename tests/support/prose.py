"""What pages and notebooks must not hold."""

import re

UNFINISHED = re.compile(r"\b(TODO|FIXME|TBD|WIP|coming soon|to be written|lorem ipsum)\b", re.IGNORECASE)
ABSOLUTE_PATH = re.compile(r"(?<![\w.:/<`)*])/[a-z_]+/[\w.]+")


def assert_fit_to_read(text: str) -> None:
    """Nothing unfinished, and no path of one machine."""
    assert not UNFINISHED.findall(text)
    assert not ABSOLUTE_PATH.findall(re.sub(r"\w+://\S+", "", text)), "paths of one machine"
