"""What the delivered viscosity is measured under: a scene's own pressure."""

import msgspec
import pytest

from app.scenes.library import find_scene
from app.validation.delivered import level_of

MERCURY = 133.322
"""Pascals in a millimetre of mercury."""


def test_the_level_is_what_all_open_ends_are_held_at_and_none_where_one_is_open_to_the_air():
    assert level_of(find_scene("aortoiliac")) == 0.0
    surgery = find_scene("aorta_surgery")
    held = [t for t in surgery.openings.values() if t.pressure is not None]
    assert held
    assert level_of(surgery) == pytest.approx(93.0 * MERCURY, rel=0.01)
    openings = dict(surgery.openings)
    name = next(n for n, t in openings.items() if t.pressure is not None)
    openings[name] = msgspec.structs.replace(openings[name], pressure=None, waveform=None)
    assert level_of(msgspec.structs.replace(surgery, openings=openings)) == 0.0
