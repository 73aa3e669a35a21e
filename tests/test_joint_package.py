"""The robot joint's package against the SSP standard, and its controller's knowledge of the drive."""

import sys

import numpy as np
import pytest
from common import EXAMPLES
from pyssp_standard.ssp import SSP

import cycloid_fmu as cy

AS_MADE = cy.read_drive(EXAMPLES / "drive-39-40-as-made.toml")


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    import joint_package

    yield joint_package
    for name in ("joint_package", "joint_parts", "bench_to_fmu"):
        sys.modules.pop(name, None)


def test_the_package_keeps_to_the_standard_and_every_connection_has_two_ends(example, tmp_path):
    path = example.joint(AS_MADE, tmp_path / "joint.ssp")
    with SSP(path) as package, package.system_structure as structure:
        structure.check_compliance(structure.schemas[structure.identifier], structure.namespaces)
        assert structure.check_connections(unconnected_inputs=True, connector_not_in_system=True) == []
        assert len(structure.list_connections()) == len(example.CONNECTIONS)
        assert sorted(package.resources) == sorted(example.COMPONENTS.values())


def test_eight_orders_hold_nearly_all_of_the_transmission_error(example, tmp_path):
    AS_MADE.build_fmu(tmp_path / "drive.fmu")
    known = example.compensation(tmp_path / "drive.fmu", -30.0)
    crank = np.linspace(3.0, 200.0, 150)
    error = cy.simulate_fmu(tmp_path / "drive.fmu", crank, -30.0, ("transmission_error",))["transmission_error"]
    left = error - example.correction(known, crank)
    assert error.std() * cy.ARCSEC > 5.0
    assert left.std() < 0.15 * error.std()
