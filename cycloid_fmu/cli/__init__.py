"""The command `cycloid-fmu`: one module per subcommand, loaded when it runs."""

from cycloid_fmu.edge import commands

app = commands.command_line(
    "cycloid-fmu",
    "Cycloid-pin gear drives: transmission error, backlash, load sharing, and FMUs made from them.",
    __name__,
    (
        "new",
        "report",
        "analyze",
        "losses",
        "draw",
        "surface",
        "build",
        "joint",
        "compensate",
        "inspect",
        "simulate",
        "compare",
        "wear",
        "budget",
        "tolerance",
        "sweep",
        "design",
        "desk",
        "profile",
        "example",
    ),
)


def main() -> None:
    """Run the command line."""
    commands.main(app)
