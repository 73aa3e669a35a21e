"""The report of figures, of maps or of a fit."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from cycloid_fmu import edge
from fitting.estimation.result import Identification
from fitting.figures.conformity import Certificate, read_certificate
from fitting.figures.metrics import Figures
from fitting.reports.certificate import write_certificate
from fitting.reports.figures_report import write_figures_report
from fitting.reports.fit_report import write_fit_report
from fitting.reports.maps_report import write_maps_report

if TYPE_CHECKING:
    import xarray as xr


def report(
    result: Figures | Identification | xr.Dataset,
    path: str | os.PathLike[str],
    *,
    certificate: Certificate | str | os.PathLike[str] | None = None,
) -> None:
    """Write the report of figures, of maps or of a fit; never a partial file.

    Parameters
    ----------
    result
        Result of `fitting.metrics`, `fitting.maps` or `fitting.identify`.
    path
        `.html`: one self-contained interactive file; `.pdf`, only for figures: the same content on pages.
    certificate
        Device, limits and decision rule, or their file; the report (`.html`) is then the certificate of this drive. It
        needs figures with budgets (`fitting.metrics(…, instruments=…)`).

    Raises
    ------
    edge.InputError
        If the name has another ending, its folder does not exist, or the certificate is invalid.

    Examples
    --------
    >>> import numpy as np, fitting, pathlib
    >>> torque = 100.0 * np.sin(np.linspace(0.0, 4.0 * np.pi, 4000))
    >>> loop = fitting.Run(input_angle=0.0, output_angle=torque / 1e6, torque=torque)
    >>> fitting.report(fitting.metrics(loop, ratio=-39.0), "report.html")
    >>> "Torsional stiffness" in pathlib.Path("report.html").read_text(encoding="utf-8")
    True
    """
    if certificate is not None:
        if not isinstance(result, Figures):
            raise edge.ArgumentError("certificate", "a certificate is only for figures", str(certificate))
        stated = certificate if isinstance(certificate, Certificate) else read_certificate(certificate)
        write_certificate(result, stated, path)
    elif isinstance(result, Identification):
        write_fit_report(result, path)
    elif isinstance(result, Figures):
        write_figures_report(result, path)
    else:
        write_maps_report(result, path)
