"""Files are complete or absent, on full disks, in closed folders, and with many writers."""

import subprocess
import sys

import pytest

from jaxnbv.errors import InputError
from jaxnbv.storage.files import make_folder, write_text, write_whole

FULL = """
import resource, signal, sys
from pathlib import Path
import matplotlib
from matplotlib.figure import Figure
from jaxnbv.errors import InputError
from jaxnbv.storage.files import write_text
from jaxnbv.viz.style import save_figure

# A file that grows beyond this is refused as on a full disk, but with "File too large".
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
folder = Path(sys.argv[1])
for write in (
    lambda: write_text(folder / "a.txt", "x" * 10**5),
    lambda: save_figure(Figure(), folder / "a.png"),
):
    try:
        write()
    except InputError as error:
        print(error)
write_text(folder / "small.txt", "it goes on")
"""


def test_a_full_disk_is_named_and_leaves_what_was_there(tmp_path):
    (tmp_path / "a.txt").write_text("before")
    run = subprocess.run([sys.executable, "-c", FULL, tmp_path], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    lines = run.stdout.splitlines()
    for line, name in zip(lines, ("a.txt", "a.png"), strict=True):
        assert f"cannot write {tmp_path / name} (File too large): make room there" in line
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {
        "a.txt": "before",
        "small.txt": "it goes on",
    }
    assert "Exception ignored" not in run.stderr


def test_a_writer_that_fails_leaves_nothing(tmp_path):
    def fail(file):
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "a", fail)
    assert not list(tmp_path.iterdir())


def test_places_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "folder", tmp_path / "nowhere" / "a", tmp_path / "file" / "a", tmp_path / ("n" * 300)):
        with pytest.raises(InputError, match=r"cannot write .*choose another place"):
            write_text(path, "x")
    for path in (tmp_path / "file", tmp_path / "file" / "a", tmp_path / ("n" * 300)):
        with pytest.raises(InputError, match=r"cannot make the output folder .*choose another place"):
            make_folder(path)
    assert {entry.name for entry in tmp_path.iterdir()} == {"folder", "file"}


@pytest.mark.slow
def test_writers_of_one_file_do_not_meet(tmp_path):
    """Each file that a reader finds is complete and from one writer."""
    script = (
        "import sys\nfrom pathlib import Path\nfrom jaxnbv.storage.files import write_text\n"
        "for _ in range(150):\n    write_text(Path(sys.argv[1]), sys.argv[2] * 50000)\n"
    )
    file = tmp_path / "a.txt"
    writers = [subprocess.Popen([sys.executable, "-c", script, file, letter], stderr=-1) for letter in "abcd"]
    while any(writer.poll() is None for writer in writers):
        if file.exists():
            text = file.read_text()
            assert text == text[0] * 50000
    for writer in writers:
        assert writer.wait() == 0, writer.stderr.read().decode()
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]
