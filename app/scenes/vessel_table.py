"""Tables that surfaces are made from: branches with radii, and the plain shapes for validation.

The tables are in millimetres, as measured.
"""

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, Union

import msgspec

from taichi_sph.errors import InputError

Positive = Annotated[float, msgspec.Meta(gt=0)]
Vector = tuple[float, float, float]
Station = tuple[float, float, float, float]


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A JSON object in which an unknown key is an error."""


class End(_Table):
    """Where a branch is cut flat."""

    name: str
    centre: Vector
    """[mm]"""
    normal: Vector
    """Outward unit normal."""
    radius: Positive
    """[mm]"""


class Branch(_Table):
    """One swept tube."""

    name: str
    points: list[Station]
    """x, y, z and radius r of the circle of the section's area [mm]."""
    ellipse: list[Vector] | None = None
    """Per point: ln(major / minor) times the unit direction of the major axis."""
    end: str | None = None
    """Opening that the last point lies at; none for a blind stub."""


class Bulge(_Table):
    """A sphere that joins the union."""

    name: str
    sphere: Station
    """x, y, z, radius [mm]."""


class Centrelines(_Table, tag_field="shape", tag="branches"):
    """A branching vessel."""

    name: str
    branches: list[Branch]
    openings: list[End]
    smoothing_length: Positive
    """Length k of the smooth union [mm]."""
    extras: list[Bulge] = []
    anatomy: str = ""
    source: str = ""
    licence: str = ""
    units: Literal["mm"] = "mm"


class Tube(_Table, tag_field="shape", tag="tube"):
    """A straight round tube about z, optionally with a smooth narrowing in its middle."""

    name: str
    radius: Positive
    """[mm]"""
    length: Positive
    """[mm]"""
    narrowing: Annotated[float, msgspec.Meta(ge=0, lt=100)] = 0.0
    """Loss of diameter in the throat [%]."""
    throat_length: Positive = 20.0
    """Length over which the tube narrows and widens again, as one wave of a cosine [mm]."""
    segments: Annotated[int, msgspec.Meta(ge=8)] = 72
    """Vertices round the tube."""
    units: Literal["mm"] = "mm"


class Revolved(_Table, tag_field="shape", tag="revolved"):
    """A straight round tube about z whose radius is given along it."""

    name: str
    profile: Annotated[list[tuple[float, Positive]], msgspec.Meta(min_length=2)]
    """z and radius [mm] of the corners, by rising z; two at one z are a step."""
    segments: Annotated[int, msgspec.Meta(ge=8)] = 72
    """Vertices round the tube."""
    units: Literal["mm"] = "mm"

    def __post_init__(self) -> None:
        """Refuse a profile that turns back.

        Raises:
            ValueError: it does, or it is closed at an end.
        """
        z = [corner[0] for corner in self.profile]
        if any(after < before for before, after in pairwise(z)) or z[0] == z[1] or z[-1] == z[-2]:
            raise ValueError("profile: z must rise from corner to corner, and may stay but between")


class Box(_Table, tag_field="shape", tag="box"):
    """A rectangular tank about the origin."""

    name: str
    size: tuple[Positive, Positive, Positive]
    """Edges along x, y, z [mm]."""
    units: Literal["mm"] = "mm"


Shape = Union[Centrelines, Tube, Revolved, Box]


def read_shape(path: Path) -> Shape:
    """Read the figures that a surface is made from.

    Raises:
        InputError: no JSON, an unknown or missing key, a value out of range.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=Shape)
    except OSError as error:
        raise InputError(f"{path}: cannot read the table: {error.strerror}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {error}") from None
