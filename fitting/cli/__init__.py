"""The command line `cycloid-fit`: one module per command."""

from typing import NoReturn

from cycloid_fmu.edge import commands

app = commands.command_line(
    "cycloid-fit",
    "Measured transmission errors: curves, figures, and the errors of the drive behind them.",
    __name__,
    (
        "curve",
        "inspect",
        "metrics",
        "friction",
        "maps",
        "report",
        "compare",
        "identify",
        "plan",
        "ensemble",
        "forecast",
        "recalibrate",
    ),
    moved={"compensate": "cycloid-fmu compensate"},
)


def main() -> NoReturn:
    """Run the command line."""
    commands.main(app)
