"""Encoders of the AMT21 family (Same Sky, CUI Devices) on RS-485: a one-byte request, a two-byte answer.

The answer is a 16-bit word, low byte first: check bits K1 K0 and 14 bits H5 … H0 L7 … L0 of position,
K1 = NOT(H5 ^ H3 ^ H1 ^ L7 ^ L5 ^ L3 ^ L1), K0 = NOT(H4 ^ H2 ^ H0 ^ L6 ^ L4 ^ L2 ^ L0) (AMT21 datasheet). So the odd
bits of a valid word together have odd parity, and so do the even bits. In a 12-bit encoder the lowest two of the 14
bits are zero. The address is a multiple of four; address + 1 requests the turns of a multi-turn encoder, a signed word
of 14 bits with the same check bits; address + 2 opens extended commands.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
import pydantic

from drivers.counts import UnseenTurns, counts_to_value, unwrap
from drivers.encoder import AngleConfig, channel_of, device_counts
from drivers.lines import PortConfig
from drivers.recording_format import GAP, RESET, ROLLOVER, FloatArray, IntArray, Samples
from drivers.serial.polled import PolledEncoder
from drivers.serial.port import MIDDLE, PortHub, ask

_TURNS = 1 << 14
_ODD, _EVEN = 0xAAAA, 0x5555


def check_bits(position: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return the words of these 14-bit positions, check bits included, shape (n,)."""
    low = np.asarray(position, np.uint16) & np.uint16(0x3FFF)
    odd = 1 - np.bitwise_count(low & np.uint16(_ODD)) % 2
    even = 1 - np.bitwise_count(low & np.uint16(_EVEN)) % 2
    return np.asarray(low | odd.astype(np.uint16) << 15 | even.astype(np.uint16) << 14, np.uint16)


def checked_position(words: npt.NDArray[np.uint16]) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.bool_]]:
    """Return the 14-bit positions of words as sent, and the mask of those with correct check bits, both (n,)."""
    words = np.asarray(words, np.uint16)
    good = (np.bitwise_count(words & np.uint16(_ODD)) % 2 == 1) & (np.bitwise_count(words & np.uint16(_EVEN)) % 2 == 1)
    return words & np.uint16(0x3FFF), good


class Amt21Config(AngleConfig):
    """A `[channel.X]` with protocol = "amt21".

    Attributes
    ----------
    port, address
        Name of the port's table, and address of the encoder, a multiple of four.
    bits
        Resolution of one turn, bits.
    multi_turn
        Whether the encoder counts turns; they are then requested with each position.
    """

    port: str
    address: Annotated[int, pydantic.Field(ge=0, le=0xFC, multiple_of=4)] = 0x54
    bits: Literal[12, 14] = 14
    multi_turn: bool = False


class Amt21Encoder(PolledEncoder):
    """One encoder at one address of a port.

    The turns of a single-turn encoder are counted here; after a gap in which it may have turned by half a turn or more,
    they are extrapolated from the speed before it, and the sample is marked as reset. A multi-turn encoder counts its
    turns itself: if readings missed some, the angle is still right, the sample is marked and an event reports it.
    """

    configuration = Amt21Config
    checksum_name: ClassVar[str] = "check bits are"

    def __init__(self, name: str, config: Amt21Config, port: PortConfig) -> None:
        super().__init__(name, config, port)
        self.where = f'{name}: AMT21 at address 0x{config.address:02X} on "{port.url}"'
        self.answer_bytes = 4 if config.multi_turn else 2
        self._questions = bytes([config.address]), bytes([config.address + 1])
        self._previous: int | None = None
        self._turns_known = False
        self._unseen = UnseenTurns(1 << config.bits)

    def question(self, port: Any) -> bytes:
        """Request the position and, from a multi-turn encoder, the turns; see `SerialEncoder.question`."""
        answer = ask(port, self._questions[0], 2)
        return answer + ask(port, self._questions[1], 2) if self.config.multi_turn else answer

    def set_up(self, hub: PortHub) -> None:
        """See `HubEncoder.set_up`."""
        counts_per_turn = device_counts(self.config, 1 << self.config.bits, self.where)
        self.asked_once(hub)
        turns = ", multi-turn" if self.config.multi_turn else ""
        self.channel = channel_of(
            self.name,
            self.config,
            identity=f"AMT21, address 0x{self.config.address:02X}, {self.config.bits} bit{turns}",
            time_source=MIDDLE,
            counts_per_turn=counts_per_turn,
        )

    def checked(self, answers: list[bytes]) -> npt.NDArray[np.bool_]:
        """See `PolledEncoder.checked`."""
        words = np.frombuffer(b"".join(answers), "<u2").reshape(len(answers), -1)
        return np.asarray(checked_position(words)[1].all(axis=1))

    def samples(self, times: FloatArray, answers: list[bytes], status: IntArray) -> Samples:
        """See `PolledEncoder.samples`."""
        words = np.frombuffer(b"".join(answers), "<u2").reshape(len(answers), -1)
        position = checked_position(words)[0].astype(np.int64)
        counts_per_turn = 1 << self.config.bits
        raw = position[:, 0] >> (14 - self.config.bits)
        counts, rolled = unwrap(raw, counts_per_turn, self._previous, signed=True)
        status = status | rolled * ROLLOVER
        if self.config.multi_turn:
            counts, missed = self._with_turns(counts, raw, position[:, 1])
            status = status | missed * (GAP | RESET)
            for i in np.flatnonzero(missed):
                self.say(times[i], "the encoder made turns that the readings missed")
        else:
            counts = self.over_gaps(self._unseen, times, counts, status)
        self._previous = int(counts[-1])
        value = counts_to_value(counts, counts_per_turn, self.config.direction, self.config.zero)
        return Samples.checked(self.name, times, value, counts=counts, status=status)

    def _with_turns(self, counts: IntArray, raw: IntArray, turns: IntArray) -> tuple[IntArray, npt.NDArray[np.bool_]]:
        """Return counts with the encoder's own turns, and the mask of changes against the turns counted here, (n,).

        Position and turns are two requests, between which the encoder may pass its zero: its turns are used only where
        the position is far from zero.
        """
        counts_per_turn = 1 << self.config.bits
        sure = np.flatnonzero((raw >= counts_per_turn // 4) & (raw < 3 * counts_per_turn // 4))
        off = (turns - counts // counts_per_turn + _TURNS // 2) % _TURNS - _TURNS // 2
        first = 0 if self._turns_known else int(off[sure[0]] if len(sure) else off[0])
        latest = np.searchsorted(sure, np.arange(len(raw)), side="right") - 1
        held = np.where(latest >= 0, off[sure[latest]], first) if len(sure) else np.full(len(raw), first)
        self._turns_known = True
        return counts + held * counts_per_turn, np.diff(held, prepend=first) != 0
