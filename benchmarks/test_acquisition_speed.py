"""How fast samples are taken: against bare loops of python-can and pyserial on the same line in the same run."""

import math
import os
import statistics
import threading
import time

import can
import pytest
import serial
from soak import peak, soak

from drivers.bench import BenchRun, simulate_motion
from drivers.can_hub import BLOCK_FRAMES, CanHub, FrameReader, open_bus
from drivers.encoder import BusConfig
from drivers.recorder import open_encoders
from drivers.serial_bench import Amt21Bench

PAIRS = int(os.environ.get("CYCLOID_PAIRS", "9"))
# The last block ends `can_hub.BLOCK_SECONDS` after it began, however fast the bus: so many frames that this is a few
# per cent of the virtual bus's time. Of UDP's the socket's buffer holds no more.
FRAMES = {"virtual": 200_000, "udp_multicast": 20_000}
SOAK = int(float(os.environ.get("CYCLOID_SOAK", "1e8")))
GROUP = "239.74.163.55"


def filled_bus(interface):
    """A bus, its sending end, and the frames to be sent to others before they receive."""
    channel = GROUP if interface == "udp_multicast" else f"speed-{time.monotonic_ns()}"
    config = BusConfig(interface=interface, channel=channel)
    sender = open_bus(config)
    messages = [
        can.Message(arbitration_id=0x181 + i % 2, is_extended_id=False, data=i.to_bytes(4, "little"), timestamp=1.0)
        for i in range(FRAMES[interface])
    ]
    return config, sender, messages


def bare_rate(interface):
    """Frames a second of a loop that does nothing but receive."""
    config, sender, messages = filled_bus(interface)
    with sender, open_bus(config) as bus:
        for message in messages:
            sender.send(message)
        begun = time.perf_counter()
        for _ in messages:
            assert bus.recv(1.0) is not None
        return len(messages) / (time.perf_counter() - begun)


def hub_rate(interface):
    """Frames a second through hub and decoding, from the first frame taken to the last sample decoded."""
    config, sender, messages = filled_bus(interface)
    hub = CanHub.__new__(CanHub)  # its thread must not begin before the frames are there
    with sender:
        waiting = open_bus(config)
        for message in messages:
            sender.send(message)
        go = threading.Event()
        receive = waiting.recv
        waiting.recv = lambda timeout=None: receive(timeout) if go.is_set() else go.wait(timeout) and None
        import drivers.can_hub as module

        original, module.open_bus = module.open_bus, lambda *_, **__: waiting
        try:
            hub.__init__(config)
        finally:
            module.open_bus = original
        readers = [FrameReader(hub, 0x181 + i, 4, None, "x") for i in (0, 1)]
        begun = time.perf_counter()
        go.set()
        waiting.recv = receive
        got = 0
        while got < len(messages):
            for reader in readers:
                block = reader.read(0.05)
                got += 0 if block is None else len(block.payloads)
        rate = len(messages) / (time.perf_counter() - begun)
        hub.close()
    assert len(messages) > BLOCK_FRAMES
    return rate


def state(benchmark, pairs, unit):
    """Put our rate beside the bare loop's: median of the pairs' ratios, and their range."""
    ratios = [ours / bare for ours, bare in pairs]
    benchmark.extra_info.update(
        {
            "per cent of the bare loop": round(100 * statistics.median(ratios)),
            "from, to": f"{100 * min(ratios):.0f}, {100 * max(ratios):.0f}",
            f"bare loop, {unit}": round(statistics.median(bare for _, bare in pairs)),
        }
    )
    print(benchmark.extra_info)


@pytest.mark.parametrize("interface", ["virtual", "udp_multicast"])
def test_frames_a_second_against_a_bare_receive_loop(benchmark, interface):
    pairs = []

    def pair():
        first, second = (hub_rate, bare_rate) if len(pairs) % 2 else (bare_rate, hub_rate)
        one, other = first(interface), second(interface)
        pairs.append((one, other) if first is hub_rate else (other, one))

    benchmark.pedantic(pair, rounds=PAIRS)
    state(benchmark, pairs, "frames/s")


def test_amt21_round_trips_against_a_bare_serial_loop(benchmark, tmp_path):
    motion = simulate_motion(lambda a, t: -a / 39, BenchRun(torque=0.0, turns=100, speed=0.01 * math.pi))
    pairs = []
    with Amt21Bench(motion) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        toml.write_text(toml.read_text().split("[channel.output_angle]")[0])

        def pair():
            with serial.serial_for_url(bench.url, baudrate=2_000_000, timeout=0.1) as port:
                begun, count = time.perf_counter(), 0
                while time.perf_counter() - begun < 1.0:
                    port.write(b"\x54")
                    assert len(port.read(2)) == 2
                    count += 1
                bare = count / (time.perf_counter() - begun)
            with open_encoders(toml) as (encoder,):
                encoder.read(0.5)
                begun, count = time.perf_counter(), 0
                while time.perf_counter() - begun < 1.0:
                    block = encoder.read(0.1)
                    count += 0 if block is None else len(block)
                pairs.append((count / (time.perf_counter() - begun), bare))

        benchmark.pedantic(pair, rounds=PAIRS)
    state(benchmark, pairs, "round trips/s")


def test_soak(benchmark, tmp_path):
    """Many samples through recorder and format at constant memory, none lost; the table is what it prints."""
    read, table, seconds = benchmark.pedantic(soak, (tmp_path / "soak.arrows", SOAK), rounds=1)
    print("\n     samples   seconds   peak MB")
    for samples, after, used in table:
        print(f"{samples:12d} {after:9.1f} {used:9d}")
    print(f"read back {read}, none lost, in {seconds:.1f} s; {peak()} MB")
    assert table[-1][2] - table[0][2] < 50
    benchmark.extra_info.update(
        {"samples": read, "lost": 0, "peak MB after a tenth": table[0][2], "at the end": table[-1][2]}
    )
