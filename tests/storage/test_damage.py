"""Damaged or foreign records and views are refused by name."""

import json
import shutil

import jax
import numpy as np
import pytest
from small_episode import run

from jaxnbv.checks import InputError
from jaxnbv.planning.episode import read_views


@pytest.mark.parametrize("text", ["", "{", "[]", "7", '{"versions": {}}', "\x80\xff"])
def test_a_corrupt_record_is_refused(tmp_path, text):
    (tmp_path / "episode.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=r"episode\.json is no episode record.*choose another output folder"):
        run(tmp_path)


@pytest.mark.parametrize("size", [0, 100, 3000])
def test_a_damaged_view_is_refused_by_name(finished, tmp_path, size):
    folder = shutil.copytree(finished[1], tmp_path / "copy")
    (folder / "view_01.npz").write_bytes((folder / "view_01.npz").read_bytes()[:size])
    with pytest.raises(ValueError, match=r"view_01.npz is damaged .* delete it"):
        run(folder, views=5)


def rewritten(file, changes, without=()):
    with np.load(file) as saved:
        arrays = {name: saved[name] for name in saved.files if name not in without}
    np.savez_compressed(file, **(arrays | changes))


def test_a_view_that_is_not_what_it_was_is_refused(finished, tmp_path):
    folder = shutil.copytree(finished[1], tmp_path / "copy")
    file, whole = folder / "view_01.npz", (folder / "view_01.npz").read_bytes()

    def problem():
        with pytest.raises(InputError, match=r"view_01\.npz is damaged .* delete it") as error:
            run(folder, views=5)
        file.write_bytes(whole)
        return str(error.value)

    shutil.copy(folder / "view_02.npz", file)
    assert "it is view 2" in problem()
    rewritten(file, {"proposal.value": np.float32(1.0)})
    assert "checksum" in problem()
    rewritten(file, {}, ["scan.missed"])
    assert "checksum" in problem()
    rewritten(file, {}, ["sha256"])
    assert "sha256" in problem()


@pytest.mark.slow
def test_no_flipped_bit_of_a_view_passes(finished, tmp_path):
    """For any single bit the file is refused by name, or its arrays are the same (some bits have no meaning)."""
    episode, folder = finished
    copy = shutil.copytree(folder, tmp_path / "copy", ignore=shutil.ignore_patterns("view_0[2-9].npz"))
    whole, expected = (folder / "view_01.npz").read_bytes(), read_views(episode.open(folder))[1]
    ends = whole.index(b"PK\x01\x02")
    # The first header, all of the directory, and a sample of the rest.
    places = [*range(60), *range(ends, len(whole), 7), *np.random.default_rng(0).integers(0, len(whole), 150)]
    refused = 0
    for place in places:
        turned = bytearray(whole)
        turned[place] ^= 1 << (place % 8)
        (copy / "view_01.npz").write_bytes(turned)
        try:
            views = read_views(episode.open(copy))
        except InputError as error:
            refused += "view_01.npz is damaged" in str(error)
            continue
        for a, b in zip(jax.tree.leaves(views[1]), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(a, b)
    assert refused > len(places) / 2


def test_an_episode_of_a_later_format_is_refused(finished, tmp_path):
    folder = shutil.copytree(finished[1], tmp_path / "copy")
    record = json.loads((folder / "episode.json").read_text())
    (folder / "episode.json").write_text(json.dumps(record | {"format": 5}))
    with pytest.raises(InputError, match=r"episode\.json is of format 5; .* install a newer one"):
        run(folder, views=5)
