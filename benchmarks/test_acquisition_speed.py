"""Rate of sampling, against bare loops of python-can and pyserial on the same line in the same run."""

import os
import statistics
import subprocess
import sys
import threading
import time

import can
import pytest
import serial
from soak import peak, soak

from drivers.can.bus import open_bus
from drivers.can.frames import FrameReader
from drivers.can.hub import BLOCK_FRAMES, CanHub
from drivers.lines import BusConfig
from drivers.recorder.bench import open_encoders

PAIRS = int(os.environ.get("CYCLOID_PAIRS", "41"))
# Whole blocks: a last one that is not full waits for `can_hub.BLOCK_SECONDS`, which is not part of the rate.
# On a busy machine many short pairs are more reliable than few long ones; UDP's socket holds no more frames.
FRAMES = 4 * BLOCK_FRAMES
ROUND_TRIPS = 2_000
SOAK = int(float(os.environ.get("CYCLOID_SOAK", "1e8")))
GROUP = "239.74.163.55"


def bus_config(interface):
    channel = GROUP if interface == "loopback" else f"speed-{time.monotonic_ns()}"
    return BusConfig(interface=interface, channel=channel)


def send_all(config):
    """Send frames of two nodes to every process that has opened the bus."""
    with open_bus(config) as sender:
        for i in range(FRAMES):
            payload = i.to_bytes(4, "little")
            sender.send(can.Message(arbitration_id=0x181 + i % 2, is_extended_id=False, data=payload))


def timed(run):
    """Things a second by the clock, and processor seconds for each; `run` returns how many there were."""
    begun, used = time.perf_counter(), time.process_time()
    count = run()
    return count / (time.perf_counter() - begun), (time.process_time() - used) / count


def bare_rate(interface):
    """A loop that does nothing but receive."""
    config = bus_config(interface)

    def receive():
        for _ in range(FRAMES):
            assert bus.recv(1.0) is not None
        return FRAMES

    with open_bus(config) as bus:
        send_all(config)
        return timed(receive)


class WaitingHub(CanHub):
    """A hub whose reader begins on request, when all frames are there."""

    def __init__(self, config):
        self.go = threading.Event()
        super().__init__(config)

    def _run(self):
        self.go.wait()
        super()._run()


def hub_rate(interface):
    """Through hub and decoding, from the first frame taken to the last sample decoded."""
    hub = WaitingHub(bus_config(interface))
    readers = [FrameReader(hub, 0x181 + i, 4, None, "x") for i in (0, 1)]
    send_all(hub.config)

    def read():
        got = 0
        hub.go.set()
        while got < FRAMES:
            for reader in readers:
                block = reader.read(0.05)
                got += 0 if block is None else len(block.payloads)
        return got

    try:
        return timed(read)
    finally:
        hub.go.set()
        hub.close()


def state(benchmark, pairs, unit):
    """Put our rate beside the bare loop's: median of the pairs' ratios, and their range; and by processor time."""
    ratios = [ours[0] / bare[0] for ours, bare in pairs]
    benchmark.extra_info.update(
        {
            "per cent of the bare loop": round(100 * statistics.median(ratios)),
            "from, to": f"{100 * min(ratios):.0f}, {100 * max(ratios):.0f}",
            "by processor time": round(100 * statistics.median(bare[1] / ours[1] for ours, bare in pairs)),
            f"bare loop, {unit}": round(statistics.median(bare[0] for _, bare in pairs)),
        }
    )
    print(benchmark.extra_info)


@pytest.mark.parametrize("interface", ["virtual", "loopback"])
def test_frames_a_second_against_a_bare_receive_loop(benchmark, interface):
    pairs = []

    def pair():
        first, second = (hub_rate, bare_rate) if len(pairs) % 2 else (bare_rate, hub_rate)
        one, other = first(interface), second(interface)
        pairs.append((one, other) if first is hub_rate else (other, one))

    benchmark.pedantic(pair, rounds=PAIRS)
    state(benchmark, pairs, "frames/s")


DEVICE = """
import math, sys
from drivers.simulated.buses import SimulatedAmt21
from drivers.simulated.motion import SimulatedRun, simulate_motion
from drivers.simulated.simulate import bench_of
motion = simulate_motion(lambda a, t: -a / 39, SimulatedRun(torque=0.0, turns=100, speed=0.01 * math.pi))
with bench_of(SimulatedAmt21(), motion) as bench:
    bench.write_wiring(sys.argv[1])
    print(bench.url, flush=True)
    sys.stdin.read()
"""


def test_amt21_round_trips_against_a_bare_serial_loop(benchmark, tmp_path):
    """The device is a process of its own, as a real one takes no time from who asks it."""
    toml = tmp_path / "BENCH.toml"
    pairs = []

    def bare(url):
        def ask():
            for _ in range(ROUND_TRIPS):
                port.write(b"\x54")
                assert len(port.read(2)) == 2
            return ROUND_TRIPS

        with serial.serial_for_url(url, baudrate=2_000_000, timeout=1.0) as port:
            return timed(ask)

    def ours():
        def read():
            count = 0
            while count < ROUND_TRIPS:
                block = encoder.read(0.1)
                count += 0 if block is None else len(block)
            return count

        with open_encoders(toml) as (encoder,):
            encoder.read(0.5)
            return timed(read)

    def pair():
        if len(pairs) % 2:
            one = bare(url)
            pairs.append((ours(), one))
        else:
            pairs.append((ours(), bare(url)))

    command = [sys.executable, "-c", DEVICE, str(toml)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as device:
        url = device.stdout.readline().strip()
        toml.write_text(toml.read_text().split("[channel.output_angle]")[0])
        benchmark.pedantic(pair, rounds=PAIRS)
        device.stdin.close()
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
