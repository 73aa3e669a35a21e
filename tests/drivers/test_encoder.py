"""Arithmetic of counts and bit fields."""

import math

import cantools
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.counts import counts_to_value, extract_bits, unwrap


@given(
    st.integers(2, 33),
    st.integers(-(10**12), 10**12),
    st.lists(st.integers(-(2**32), 2**32), max_size=30),
    st.integers(0, 30),
)
def test_unwrapping_restores_any_motion_of_less_than_half_a_range_per_sample(bits, first, steps, cut):
    modulus = 1 << bits
    limit = modulus // 2 - 1
    counts = np.cumsum([first, *(max(-limit, min(limit, s)) for s in steps)])
    cut = min(cut, len(counts) - 1) or 1
    head, _ = unwrap(counts[:cut] % modulus, modulus, previous=None)
    tail, _ = unwrap(counts[cut:] % modulus, modulus, previous=int(head[-1]))
    whole = np.concatenate([head, tail])
    assert np.array_equal(np.diff(whole), np.diff(counts))
    assert 0 <= whole[0] < modulus


def test_a_rollover_is_marked_at_its_sample():
    counts, rolled = unwrap(np.array([4094, 4095, 0, 1, 4095]), 4096)
    assert counts.tolist() == [4094, 4095, 4096, 4097, 4095]
    assert rolled.tolist() == [False, False, True, False, True]


def test_a_signed_encoder_just_below_zero_begins_below_zero():
    assert unwrap(np.array([2**32 - 3, 1]), 2**32, signed=True)[0].tolist() == [-3, 1]
    assert unwrap(np.array([2**32 - 3, 1]), 2**32)[0].tolist() == [2**32 - 3, 2**32 + 1]


def test_nothing_unwraps_to_nothing():
    counts, rolled = unwrap(np.zeros(0, np.int64), 4096, 17)
    assert len(counts) == len(rolled) == 0


def test_a_quarter_turn_backwards_from_a_zero_of_30_degrees():
    assert counts_to_value(np.array([1024]), 4096, -1, math.radians(30)) == pytest.approx(math.radians(-120))


@given(
    st.data(), st.integers(1, 32), st.booleans(), st.booleans(), st.lists(st.binary(min_size=8, max_size=8), min_size=1)
)
def test_bit_fields_agree_with_cantools(data, length, signed, little, frames):
    if little:
        start = data.draw(st.integers(0, 64 - length))
        dbc_start, field_start = start, start
    else:
        field_start = data.draw(st.integers(0, 64 - length))
        dbc_start = field_start // 8 * 8 + 7 - field_start % 8
    order, sign = (1 if little else 0), ("-" if signed else "+")
    text = f'VERSION ""\nBU_: a\nBO_ 1 m: 8 a\n SG_ s : {dbc_start}|{length}@{order}{sign} (1,0) [0|0] "" a\n'
    message = cantools.database.load_string(text, "dbc").messages[0]
    payloads = np.frombuffer(b"".join(frames), np.uint8).reshape(-1, 8)
    found = extract_bits(payloads, field_start, length, signed=signed, little_endian=little)
    assert found.tolist() == [message.decode(f)["s"] for f in frames]
