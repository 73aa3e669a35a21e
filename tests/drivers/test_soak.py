"""A tenth of the soak test in benchmarks/test_acquisition_speed.py."""

import pytest
from soak import soak


@pytest.mark.slow
def test_ten_million_samples_at_constant_memory(tmp_path, record_property):
    read, table, _ = soak(tmp_path / "soak.arrows", 10_000_000)
    assert read >= 3 * (10_000_000 // 3)
    assert table[-1][2] - table[0][2] < 50
    record_property("samples, none lost", str(read))
    record_property("memory after a tenth and at the end", f"{table[0][2]} and {table[-1][2]} MB")
