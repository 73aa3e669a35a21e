"""Provenance in results, which depends only on the drive's values."""

from __future__ import annotations

import hashlib

import numpy as np

from cycloid_fmu.errors.kinds import kinds_of
from cycloid_fmu.errors.stated import Errors
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.surface import ErrorSurface


def stating(pair: Pair, surface: ErrorSurface) -> Pair:
    """Return the pair with the errors of a surface as stated errors, without form and wear of elements."""
    values = {kind.file_key: np.asarray(surface.errors[name]) for name, kind in kinds_of(pair).items()}
    return pair.replace(errors=Errors({key: value.tolist() for key, value in values.items() if value.any()}))


def drive_text(pair: Pair, surface: ErrorSurface) -> str:
    """Return a drive as the text of a pair file, which `parse_pair` reads; without form and wear of elements."""
    return stating(pair, surface).text


def drive_hash(pair: Pair, surface: ErrorSurface, first_stage: str = "") -> str:
    """Return the fingerprint of all values of a drive, its first stage's text among them, 16 hexadecimal digits."""
    return hashlib.sha256(f"{pair.nominal.text}{surface.hash}{first_stage}".encode()).hexdigest()[:16]


def provenance(pair: Pair, surface: ErrorSurface) -> dict[str, str]:
    """Return the attributes that every result carries: the drive's text, its fingerprint, and the surface's origin."""
    return {
        "pair": drive_text(pair, surface),
        "drive": drive_hash(pair, surface),
        "surface": surface.origin,
    }
