"""Files that get their name only when they are complete."""

import os
import stat

import pytest

from osik_jax._whole_file import whole_file, write_text


def test_links_devices_and_permissions_stay(tmp_path):
    file, link, nothing = tmp_path / "file", tmp_path / "link", tmp_path / "nothing"
    write_text(file, "older")
    file.chmod(0o640)
    link.symlink_to(file)
    write_text(link, "ä\n")
    assert link.is_symlink() and file.read_bytes() == "ä\n".encode() and stat.S_IMODE(file.stat().st_mode) == 0o640
    nothing.symlink_to(os.devnull)
    write_text(nothing, "text")
    assert nothing.is_char_device() and sorted(path.name for path in tmp_path.iterdir()) == ["file", "link", "nothing"]


def test_after_an_error_the_older_file_stays(tmp_path):
    write_text(path := tmp_path / "file", "older")
    with pytest.raises(RuntimeError), whole_file(path) as file:
        file.write(b"new")
        raise RuntimeError
    assert path.read_text() == "older" and [one.name for one in tmp_path.iterdir()] == ["file"]
    missing = tmp_path / "none" / "file"
    with pytest.raises(FileNotFoundError) as caught:
        write_text(missing, "text")
    assert caught.value.filename == str(missing)
