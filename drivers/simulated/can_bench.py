"""The simulated bench on a CAN bus: two CiA 406 encoders, a torque transducer and a controller."""

from __future__ import annotations

import contextlib
import math
import queue
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np

from cycloid_fmu import edge
from drivers.can.bus import SYNC_ID, open_bus
from drivers.can.hub import SYNC_COUNTER_MAX
from drivers.encoders.canopen import COUNTS_PER_TURN, HEARTBEAT_TIME, POSITION, TURNS
from drivers.lines import BusConfig
from drivers.recording_format import FloatArray
from drivers.simulated.bench import SimulatedBench
from drivers.simulated.buses import SimulatedCan
from drivers.simulated.faults import NODE_FAULTS, Fault, Frame, faulty_frames
from drivers.simulated.motion import Motion, quantised

with edge.needs_extra("bench"):
    import canopen
    from canopen.objectdictionary import UNSIGNED8, UNSIGNED16, UNSIGNED32, ODRecord, ODVariable

_END_SECONDS = 2.0  # without an operational node: nobody is listening
_UP_SECONDS = 1000.0  # since power-up of an interface with its own clock
UDP_SAMPLES_PER_SECOND = 2000.0  # four datagrams each; the kernel drops datagrams not read in time
_INPUT_NODE, _OUTPUT_NODE = 1, 2
_TORQUE_ID, _TORQUE_SCALE = 0x2A0, 0.0001
_TORQUE_DBC = f"""VERSION ""
NS_ :
BS_:
BU_: bench

BO_ {_TORQUE_ID} torque: 4 bench
 SG_ torque : 0|32@1- ({_TORQUE_SCALE},0) [-200000|200000] "Nm" bench
"""


def _turns(counts_per_turn: int) -> int:
    """Return the number of turns that a 32-bit position can count, limited to the 16 bits of 0x6502."""
    return min((1 << 32) // counts_per_turn, 1 << 15)


def _object_dictionary(node: int, identifier: int, counts_per_turn: int, timer: int | None) -> canopen.ObjectDictionary:
    """Return the object dictionary of a CiA 406 encoder, whose TPDO1 is sent on every SYNC or by a timer, ms."""
    dictionary = canopen.ObjectDictionary()

    def variable(name: str, index: int, kind: int, value: int, sub: int = 0) -> ODVariable:
        item = ODVariable(name, index, sub)
        item.data_type, item.default = kind, value
        item.access_type = "rw" if index == HEARTBEAT_TIME else "ro"
        return item

    def record(name: str, index: int, entries: Sequence[tuple[str, int, int]]) -> None:
        item = ODRecord(name, index)
        item.add_member(variable("entries", index, UNSIGNED8, len(entries)))
        for sub, (entry, kind, value) in enumerate(entries, 1):
            item.add_member(variable(entry, index, kind, value, sub))
        dictionary.add_object(item)

    for name, index, kind, value in (
        ("device type", 0x1000, UNSIGNED32, 0x00020196),
        ("error register", 0x1001, UNSIGNED8, 0),
        ("heartbeat time", HEARTBEAT_TIME, UNSIGNED16, 0),
        ("operating parameters", 0x6000, UNSIGNED16, 0),
        ("position", POSITION, UNSIGNED32, 0),
        ("operating status", 0x6500, UNSIGNED16, 0),
        ("counts per turn", COUNTS_PER_TURN, UNSIGNED32, counts_per_turn),
        ("turns", TURNS, UNSIGNED16, _turns(counts_per_turn)),
        ("profile and software", 0x6507, UNSIGNED32, 0x01000302),
        ("encoder serial", 0x650B, UNSIGNED32, node),
    ):
        dictionary.add_object(variable(name, index, kind, value))
    who = [("vendor", 0), ("product", 0x406), ("revision", 1), ("serial", node)]
    record("identity", 0x1018, [(entry, UNSIGNED32, value) for entry, value in who])
    sent = [("identifier", UNSIGNED32, identifier), ("transmission type", UNSIGNED8, 1 if timer is None else 254)]
    if timer is not None:
        sent += [("inhibit time", UNSIGNED16, 0), ("compatibility", UNSIGNED8, 0), ("event timer", UNSIGNED16, timer)]
    record("TPDO1", 0x1800, sent)
    record("TPDO1 mapping", 0x1A00, [("position", UNSIGNED32, POSITION << 16 | 32)])
    return dictionary


class _StampedNetwork(canopen.Network):  # type: ignore[misc]
    """A network that stamps its service frames with a clock, as the bus keeps the stamps it is given."""

    NOTIFIER_CYCLE = 0.02

    def __init__(self, bus: can.BusABC, stamp: Callable[[float], float]) -> None:
        super().__init__(bus)
        self._stamp = stamp

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        message = can.Message(
            timestamp=self._stamp(time.time()),
            arbitration_id=can_id,
            is_extended_id=can_id > 0x7FF,
            data=data,
            is_remote_frame=remote,
        )
        with self.send_lock:
            self.bus.send(message)


class SimulatedCanBench(SimulatedBench):
    """A bench on a CAN bus: two CiA 406 nodes, a torque transducer and, by default, a controller that sends SYNC.

    Once both nodes are operational, a thread sends the motion; it ends with the motion or when no node is operational.
    A node that is not operational sends nothing. On the virtual bus the frames are stamped with the motion's own time.

    Attributes
    ----------
    sent
        Number of samples sent so far.
    sent_at, sent_by
        Earliest and latest time at which each sample was taken, s since 1970 on this process's clock, shape (samples,);
        0 for samples not sent. With the interface's own clock both are equal; a sample that answers the SYNC of another
        device is taken after that SYNC.
    """

    def __init__(self, motion: Motion, description: SimulatedCan) -> None:
        super().__init__(motion, description)
        interface, pace = description.interface, description.speed_factor
        channel = description.channel or ("239.74.163.2" if interface == "loopback" else "bench")
        self.bus_config, self.allow = BusConfig(interface=interface, channel=channel), (interface,)
        self.counts_per_turn = {
            _INPUT_NODE: description.input_counts_per_turn,
            _OUTPUT_NODE: description.output_counts_per_turn,
        }
        self.trigger, self.clock_drift, self._powered = description.trigger, description.clock_drift, time.time()
        self._stamped = interface == "virtual" or self.clock_drift is not None  # by the bench, not by the kernel
        own = 2 * math.pi / motion.run.samples_per_turn / motion.run.speed
        if self.trigger == "sync":
            self._interval = own
        elif pace is not None or self.clock_drift is not None:
            self._interval = own / (pace or 1.0)
        else:
            self._interval = 0.0 if interface == "virtual" else 1 / UDP_SAMPLES_PER_SECOND
        self._pace = self._interval / own
        self._timer = own if interface == "virtual" else self._interval  # the virtual bus has the motion's time
        self._syncs: queue.SimpleQueue[float] = queue.SimpleQueue()  # arrival times
        self.sent = 0
        self.sent_at, self.sent_by = np.zeros((2, motion.run.samples))

    def _open(self) -> None:
        options: dict[str, Any] = {"preserve_timestamps": True} if self._stamped else {}
        self._bus = open_bus(self.bus_config, **options)
        self._network = _StampedNetwork(self._bus, self._stamp)
        self._network.connect()
        self._nodes = {}
        timer = max(1, round(self._timer * 1000)) if self.trigger == "timer" else None
        for node, resolution in self.counts_per_turn.items():
            dictionary = _object_dictionary(node, 0x180 + node, resolution, timer)
            local = self._network.create_node(node, dictionary)
            local.nmt.state = "INITIALISING"
            local.nmt.state = "PRE-OPERATIONAL"
            self._nodes[node] = local
        if self.trigger == "sync":
            self._network.subscribe(SYNC_ID, lambda _, __, stamp: self._syncs.put(stamp))

    def _close(self) -> None:
        for node in self._nodes.values():
            node.nmt.stop_heartbeat()
        self._network.disconnect()

    def _connections(self, folder: Path) -> str:
        angles = "".join(
            f'[channel.{name}]\nprotocol = "canopen"\nbus = "can0"\nnode = {node}\nsigned = true\n\n'
            for name, node in (("input_angle", _INPUT_NODE), ("output_angle", _OUTPUT_NODE))
        )
        sync = f'sync_period = "{self._interval:.9g} s"\n' if self.trigger == "sync" else ""
        with edge.written_whole(folder / "torque.dbc") as temporary:
            temporary.write_text(_TORQUE_DBC, encoding="utf-8")
        return (
            f"[bus.can0]\ninterface = {edge.json_text(self.bus_config.interface)}\n"
            f"channel = {edge.json_text(self.bus_config.channel)}\n{sync}\n{angles}"
            '[channel.torque]\nprotocol = "dbc"\nbus = "can0"\nfile = "torque.dbc"\nmessage = "torque"\n'
            f'signal = "torque"\nsync = {"false" if self.trigger == "timer" else "true"}\n'
        )

    def _end(self) -> dict[str, Any]:
        return {"samples": self.motion.run.samples, "idle": 5.0}

    def _stamp(self, host: float) -> float:
        """Return the time of the interface's clock at a host time, s."""
        if self.clock_drift is None:
            return host
        return _UP_SECONDS + (host - self._powered) * (1 + self.clock_drift)

    def _operational(self) -> list[bool]:
        return [node.nmt.state == "OPERATIONAL" for node in self._nodes.values()]

    def _run(self) -> None:
        while not all(self._operational()):
            if self._stopping.wait(0.005):
                return
        self._send()

    def _positions(self, node: int, angle: FloatArray) -> np.ndarray[Any, np.dtype[np.uint32]]:
        """Return the values of object 0x6004 of a node at these angles, rad, shape (n,)."""
        resolution = self.counts_per_turn[node]
        return (quantised(angle, resolution) % (resolution * _turns(resolution))).astype("<u4")

    def _frames(self) -> Iterator[list[Frame]]:
        """Yield the frames of each sample, with faults: identifier, data and stamp, s since the start."""
        motion = self.motion
        payloads: dict[int, Any] = {
            0x180 + _INPUT_NODE: self._positions(_INPUT_NODE, motion.input_angle),
            0x180 + _OUTPUT_NODE: self._positions(_OUTPUT_NODE, motion.output_angle),
            _TORQUE_ID: np.rint(motion.torque / _TORQUE_SCALE).astype("<i4"),
        }
        for fault in self.description.faults:
            if fault.kind == "reset":  # the counter restarts at zero at the present shaft angle
                array = payloads[fault.target]
                array[fault.sample :] -= array[fault.sample]
        if self.trigger == "controller":
            payloads = {SYNC_ID: (np.arange(len(motion.time)) % SYNC_COUNTER_MAX + 1).astype("u1"), **payloads}
        raw = [(identifier, array.tobytes(), array.itemsize) for identifier, array in payloads.items()]
        if not self.description.sync_counter:
            raw = [(identifier, data, 0 if identifier == SYNC_ID else size) for identifier, data, size in raw]
        samples = (
            [(identifier, data[i * size : (i + 1) * size], stamp) for identifier, data, size in raw]
            for i, stamp in enumerate(motion.time)
        )
        return faulty_frames(samples, self.description.faults)

    def _send(self) -> None:
        """Send all samples: SYNC, if the bench has a controller, then the frames that it triggers."""
        frames, at = self._frames(), {f.sample: f for f in self.description.faults if f.kind in NODE_FAULTS}
        nodes = {0x180 + number: node for number, node in self._nodes.items()}
        silent: dict[int, int] = {}
        begun, ends = time.time(), math.inf
        send, interval, stamped = self._bus.send, self._interval, self._stamp
        pace = self._pace if self.clock_drift is not None else 1.0
        own = self._stamped and self.trigger != "sync"
        for i, sample in enumerate(frames):
            while not any(self._operational()):
                ends = min(ends, time.monotonic() + _END_SECONDS)
                if self._stopping.wait(0.005) or time.monotonic() > ends:
                    return
            ends = math.inf
            if self._stopping.is_set():
                return
            asked = self._asked() if self.trigger == "sync" else self._due(begun + i * interval)
            if asked is None:
                return
            if i in at:
                self._befall(at[i], silent)
            now, due = time.time(), begun + float(self.motion.time[i]) * pace
            self.sent_at[i] = due if own else asked
            for identifier, data, stamp in sample:
                node = nodes.get(identifier)
                if node is not None and (node.nmt.state != "OPERATIONAL" or silent.get(node.id, -1) > i):
                    continue
                # An answer to the SYNC of another device is stamped by the same clock as that SYNC.
                when = stamped(now if self.trigger == "sync" else begun + stamp * pace)
                send(can.Message(timestamp=when, arbitration_id=identifier, is_extended_id=False, data=data))
            for number in [n for n, end in silent.items() if end == i]:
                self._nodes[number].nmt.start_heartbeat(self._nodes[number].sdo[HEARTBEAT_TIME].raw)
            self.sent_by[i] = due if own else time.time()
            self.sent = i + 1

    def _due(self, due: float) -> float | None:
        """Wait until a time, s since 1970, and return the present time; None if the bench is stopped meanwhile."""
        wait = due - time.time()
        return None if wait > 0 and self._stopping.wait(wait) else time.time()

    def _asked(self) -> float | None:
        """Wait for the SYNC of another device and return its arrival time; None if no node is operational any more."""
        while not self._stopping.is_set() and any(self._operational()):
            with contextlib.suppress(queue.Empty):
                return self._syncs.get(timeout=0.05)
        return None

    def _befall(self, fault: Fault, silent: dict[int, int]) -> None:
        """Apply a fault of a node or the bus that is not in the data frames."""
        if fault.kind == "bus_off":
            self._bus.send(can.Message(timestamp=time.time(), arbitration_id=0x40, is_error_frame=True, dlc=8))
            return
        node = self._nodes[fault.target & 0x7F]
        if fault.kind == "emergency":
            node.emcy.send(0x5530, 0x01)
        elif fault.kind == "reboot":
            node.nmt.state = "INITIALISING"
            node.nmt.state = "PRE-OPERATIONAL"
        elif fault.kind == "silence":
            node.nmt.stop_heartbeat()
            silent[node.id] = fault.sample + fault.count
