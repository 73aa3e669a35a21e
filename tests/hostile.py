"""Files made to stop the program that reads them, from whole ones; and limits for readers in this process."""

import contextlib
import re
import resource
import signal
import struct
import zlib
from pathlib import Path


def self_links(mdf):
    """MDF 4 files in which one link of a block leads to the block itself."""
    for block in re.finditer(rb"##(HD|FH|DG|CG|CN|CC|DT|DL|DZ|HL|AT|CH|SI|EV)", mdf):
        at = block.start()
        _, count = struct.unpack_from("<QQ", mdf, at + 8)
        for link in range(at + 24, at + 24 + 8 * count, 8):
            yield mdf[:link] + struct.pack("<Q", at) + mdf[link + 8 :]


def self_linked_group(mdf):
    """An MDF 4 file whose first data group is its own successor."""
    at = mdf.index(b"##DG")
    return mdf[: at + 24] + struct.pack("<Q", at) + mdf[at + 32 :]


def compressed_bomb(mdf):
    """An MDF 4 file whose first compressed block unpacks to 1.3 GB of zeros, as it says."""
    at = mdf.index(b"##DZ")
    packer = zlib.compressobj(1)
    packed = b"".join(packer.compress(bytes(1 << 24)) for _ in range(80)) + packer.flush()
    head = struct.pack("<4s4xQQ", b"##DZ", 48 + len(packed), 0)
    about = mdf[at + 24 : at + 32] + struct.pack("<QQ", 80 << 24, len(packed))
    # At the end of the file; the link that led to the block leads there.
    return mdf.replace(struct.pack("<Q", at), struct.pack("<Q", len(mdf))) + head + about + packed


def endless_signal(dbc):
    """A DBC file whose first signal has 2^31 bits."""
    return re.sub(rb"\|\d+@", b"|2147483648@", dbc, count=1)


def far_signal(dbc):
    """A DBC file whose first signal begins at bit 10^8."""
    return re.sub(rb": \d+\|", b": 100000000|", dbc, count=1)


def far_member(netcdf):
    """A netCDF file in which the member of a type lies beyond 2 GiB: NumPy adds its size and overflows."""
    at = netcdf.index(b"dataset\0") + 8
    return netcdf[:at] + struct.pack("<I", 0x7FFFFFFF) + netcdf[at + 4 :]


class Hung(BaseException):
    """A reader computed for longer than any person waits."""


@contextlib.contextmanager
def within(seconds, size):
    """Limit the processor time, and the address space on top of what is in use, bytes."""

    def stop(number, frame):
        raise Hung(f"more than {seconds} s")

    # Processor time: on a busy machine the wall clock does not measure a reader.
    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    allowed = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + size, allowed[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, allowed)
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
