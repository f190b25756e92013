"""`faceanim studio`: a page in the browser to animate a face and to place its muscles."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

from faceanim.cli.choices import add_simulation, face_asked, solver_options, use_threads, whole
from faceanim.ground.errors import UserError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `faceanim studio`."""
    parser.add_argument("--host", default="127.0.0.1", metavar="ADDRESS",
                        help="where to serve the page; anything but %(default)s lets other machines in")  # fmt: skip
    parser.add_argument("--port", default="8080", metavar="N", help="port of the page, 0 = any (default: %(default)s)")
    parser.add_argument("--work", default="studio", metavar="DIR",
                        help="folder that muscles and recordings are saved in as you go (default: %(default)s)")  # fmt: skip
    parser.add_argument("--no-browser", action="store_true", help="print the address, open no browser")
    add_simulation(parser)


def run(args: argparse.Namespace) -> int:
    """Serve the page until interrupted."""
    if find_spec("viser") is None:
        raise UserError("faceanim studio needs the extra 'studio': pip install 'faceanim[studio]'")
    port = whole(args.port, "--port", 0, 65_535)
    from faceanim.cli.warmup import drawing_compiled
    from faceanim.studio.engine import Setup
    from faceanim.studio.page import Studio, check_place

    args.adaptive = False if args.adaptive is None else args.adaptive
    options = solver_options(args)
    use_threads(args.threads)
    check_place(args.host, port)
    face = face_asked(args)
    work = _work_folder(Path(args.work))
    setup = Setup(face.body(), args.backend, options)
    with ExitStack() as stack:
        finish = stack.enter_context(drawing_compiled())
        studio = Studio(face, setup, work, host=args.host, port=port, prepare_drawing=finish)
        stack.callback(studio.close)
        print(f"faceanim studio: {studio.address} (Ctrl-C ends it); work is saved in {work}", flush=True)
        if not args.no_browser and _display():
            import webbrowser

            webbrowser.open(studio.address)
        studio.wait()
    return 0


def _work_folder(folder: Path) -> Path:
    """Make the folder for the work; raise `UserError` naming --work if that cannot be done."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--work {folder} cannot be made ({error.strerror}); choose another folder") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise UserError(f"--work {folder} cannot be written; choose another folder")
    return folder


def _display() -> bool:
    """Whether a browser could open here."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
