"""Pictures: offscreen, of the right size, with a hand on them."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_description.parameters import load_parameters
from hannes_sim.objects import SOFT_BALL

render = pytest.importorskip("hannes_sim.render")


@pytest.fixture(scope="module")
def renderer():
    try:
        made = render.HandRenderer(load_parameters("hannes"), None, SOFT_BALL, width=160, height=120)
    except HannesError as error:
        pytest.skip(str(error))
    yield made
    made.close()


def test_open_and_closed_hand_look_different_from_each_view(renderer) -> None:
    for view in render.VIEWS:
        opened, closed = renderer.draw(render.OPEN, view), renderer.draw(render.CLOSED, view)
        assert opened.shape == (120, 160, 3) and opened.dtype == np.uint8
        assert opened.std() > 10.0
        assert (np.abs(opened.astype(int) - closed.astype(int)).max(axis=2) > 40).mean() > 0.01


def test_the_same_pose_gives_the_same_picture(renderer) -> None:
    assert np.array_equal(renderer.draw(render.CLOSED), renderer.draw(render.CLOSED))


def test_png_holds_the_picture(tmp_path: Path, renderer) -> None:
    image = renderer.draw(render.OPEN)
    content = render.save_png(
        render.side_by_side([image, image]), tmp_path / "deep" / "hand.png"
    ).read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">II", content[16:24]) == (320, 120)
    at = content.index(b"IDAT")
    size = struct.unpack(">I", content[at - 4 : at])[0]
    rows = np.frombuffer(zlib.decompress(content[at + 4 : at + 4 + size]), dtype=np.uint8).reshape(
        120, 1 + 3 * 320
    )
    assert np.array_equal(rows[:, 1:481].reshape(120, 160, 3), image)


def test_wrong_input_is_named(renderer) -> None:
    with pytest.raises(HannesError, match="palm, side, thumb"):
        renderer.draw(render.OPEN, "moon")
    with pytest.raises(HannesError, match="13 finite"):
        renderer.draw(np.zeros(5))
    with pytest.raises(HannesError, match="shape"):
        render.save_png(np.zeros((4, 4), dtype=np.uint8), "x.png")
