"""Entry of the `faceanim` command: parse, load the one command that is asked for, turn errors into exit statuses.

Exit status: 0 done, 2 the user's mistake, 1 a run that failed, 130 interrupted. Set FACEANIM_DEBUG=1 for tracebacks.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import NoReturn

from faceanim.ground.errors import FaceanimError, UserError, unknown_name

COMMANDS = {
    "express": "make pictures and a film of a face that shows an expression",
    "framerate": "measure speed and accuracy for every expression, beside the published figures",
    "compare": "chart error against cost for every backend, scheme, density and step on a scene",
    "atlas": "map where every scheme is stable, and where it fails and how",
    "plan": "choose the cheapest way to animate a scene that is accurate and fast enough",
    "claims": "measure what the papers print, figure by figure: ours beside theirs, with a verdict",
    "surgery": "cut and move facial bones as a plan says and predict the skin",
    "studio": "animate a face and place its muscles in the browser",
    "muscles": "read, draw and check facial muscle images",
    "info": "list faces, muscles, expressions, action units and backends",
    "warmup": "compile ahead of time, so that the first run starts at once",
}
"""Command -> what it does; command `x` is the module `faceanim.cli.x` with `add_arguments(parser)` and `run(args)`."""


class Parser(argparse.ArgumentParser):
    """A parser whose complaints are errors like all others, one line long."""

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (see `{self.prog} --help`)")


def build_parser(command: str | None) -> Parser:
    """Return the parser; only `command` gets its options, so that nothing else has to be imported."""
    from faceanim import __version__

    parser = Parser(prog="faceanim", description="Physically based facial animation: named expressions to frames.")
    parser.add_argument("--version", action="version", version=f"faceanim {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)
    for name, text in COMMANDS.items():
        sub = subparsers.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.", allow_abbrev=False)
        if name == command:
            import_module(f"faceanim.cli.{name}").add_arguments(sub)
    return parser


def run(argv: Sequence[str]) -> int:
    """Run the command line `argv` (without the program's name) and return its exit status; errors pass through."""
    command = next((word for word in argv if not word.startswith("-")), None)
    if command is not None and command not in COMMANDS:
        raise unknown_name("command", command, COMMANDS)
    parser = build_parser(command)
    args = parser.parse_args(argv)
    if args.command is None:
        parser.print_help()
        return 0
    return int(import_module(f"faceanim.cli.{args.command}").run(args))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status; every failure is one line on standard error."""
    try:
        return run(sys.argv[1:] if argv is None else argv)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if os.environ.get("FACEANIM_DEBUG"):
            raise
        return _fail(_described(error), 2 if isinstance(error, UserError) else 1)


def _described(error: Exception) -> str:
    if isinstance(error, FaceanimError):
        return str(error)
    if isinstance(error, MemoryError):
        return "out of memory; choose a smaller size, density or duration"
    if isinstance(error, OSError):
        return f"{error.filename or 'file'}: {error.strerror or error}"
    return f"unexpected {type(error).__name__}: {error}; FACEANIM_DEBUG=1 shows where"


def _fail(message: str, status: int) -> int:
    print("faceanim: error: " + " ".join(message.split()), file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
