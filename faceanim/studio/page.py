"""The page: a viser server with the head, the tabs, and the simulation behind them."""

from __future__ import annotations

import contextlib
import io
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from time import sleep
from typing import Any
from urllib.parse import urlsplit

from viser import ViserServer

from faceanim.face.library import asset_text
from faceanim.face.muscles import both_sides, build_muscles, one_sided, parse_muscles
from faceanim.ground.errors import FaceanimError, RunError
from faceanim.studio.document import MuscleDocument
from faceanim.studio.engine import Setup
from faceanim.studio.live import LiveTab
from faceanim.studio.muscle_editor import MuscleTab
from faceanim.studio.node_sets import NodeSets
from faceanim.studio.recorder import Recorder
from faceanim.studio.scene import HeadScene
from faceanim.studio.simulation import LiveSimulation, Moment, Target

STATUS_EVERY = 0.5
"""Time between two updates of the line of figures [s]."""
COLOURS: dict[str, Any] = {"error": "red", "warning": "yellow", "info": "blue", "done": "green"}


class Server(ViserServer):
    """A viser server that opens no tunnel to the outside, and listens to no page but its own."""

    def __init__(self, host: str, port: int) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            super().__init__(host=host, port=port, label="faceanim studio", verbose=False)
        self._websock_server.on_client_connect(self._refuse_strangers)

    async def _refuse_strangers(self, connection: Any) -> None:
        """Close connections that a page from elsewhere opens in the user's browser, before anything is sent."""
        socket = getattr(self._websock_server, "_live_connections", {}).get(connection.client_id)
        if socket is not None and not own_page(socket.request.headers, self.get_host()):
            await socket.close(1008, "this page belongs to another server")

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse."""
        return None


class Studio:
    """Everything behind the page; `close` ends it.

    face : the head    setup : what is simulated at first    work : folder that work is saved in as it goes
    prepare_drawing : called, and waited for, before the first picture is drawn
    """

    def __init__(
        self,
        face: Any,
        setup: Setup,
        work: Path,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        prepare_drawing: Callable[[], Any] = lambda: None,
    ) -> None:
        self.face, self.work = face, work
        self.document = MuscleDocument(work, face.muscle_table)
        known = both_sides(parse_muscles(asset_text("muscles.toml"), "muscles.toml"))
        self.standard_names = tuple(known)
        if self.document.table != one_sided(face.muscle_table):
            body = replace(setup.body, muscles=build_muscles(self.document.table, face.terrain))
            setup = replace(setup, body=body)
        self._target, self._pull = Target(), dict[str, float]()
        self.server = Server(host, port)
        self.server.gui.configure_theme(
            control_width="large", dark_mode=True, show_logo=False, show_share_button=False, brand_color=(88, 148, 190)
        )
        self.server.gui.main_panel.dock_right()
        self.simulation = LiveSimulation(face, setup, self._moved, self.message)
        self.recorder = Recorder(face, work, self._recorded)
        self.scene = HeadScene(self.server, face)
        self.sets = NodeSets(face.jaw, self.scene.set_node_sets, self.message)
        self._preparing = "the simulation"
        self._moment: Moment | None = None
        self._chosen = ""
        self._closing = threading.Event()
        tabs = self.server.gui.add_tab_group()
        with tabs.add_tab("Live"):
            self.live = LiveTab(self)
        with tabs.add_tab("Muscles"):
            self.muscles = MuscleTab(self, self.document, prepare_drawing)
        self._notices = list(self.document.notices)
        self.server.on_client_connect(lambda _: self._look())
        self.server.on_client_disconnect(lambda _: self._look())
        self.simulation.pause(True)
        self.simulation.start()
        self._teller = threading.Thread(target=self._tell, name="studio-status", daemon=True)
        self._teller.start()

    @property
    def address(self) -> str:
        """Where the page is."""
        host = self.server.get_host()
        return f"http://{'localhost' if host in ('0.0.0.0', '::') else host}:{self.server.get_port()}"

    def close(self) -> None:
        """End simulation and server; a running recording is finished first."""
        self._closing.set()
        self.recorder.close()
        self.muscles.close()
        self.simulation.stop()
        self.sets.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def aim(self, target: Target) -> None:
        """Send the face to `target`."""
        self._target = target
        self._aim()

    def pull(self, activation: dict[str, float], chosen: str) -> None:
        """Pull some muscles on top of what the sliders ask; the `chosen` one stands out."""
        self._pull, self._chosen = activation, chosen
        self._aim()

    def _aim(self) -> None:
        activation = dict(self._target.activation)
        for name, value in self._pull.items():
            activation[name] = max(activation.get(name, 0.0), value)
        target = Target(activation, self._target.jaw)
        self.simulation.aim(target)
        self.sets.follow(self.simulation.setup, target)
        self.scene.paint_muscles(activation, self._chosen)

    def _moved(self, moment: Moment) -> None:
        self._moment = moment
        self.scene.show(moment)
        self.recorder.add(moment)

    def _look(self) -> None:
        """Simulate while somebody looks or a recording runs."""
        while self._notices and self.server.get_clients():
            self.notify("warning", "Saved work", self._notices.pop())
        self.simulation.pause(not self.server.get_clients() and not self.recorder.running)

    def message(self, kind: str, text: str) -> None:
        """Show what the simulation reports."""
        self._preparing = text if kind == "preparing" else ""
        if kind == "diverged":
            self.live.rest(aim=False)
            self.notify("error", "The simulation diverged", text)
        elif kind == "error":
            self.notify("error", "That did not work", text)
        if kind in ("error", "ready"):
            self.live.show_setup()

    def notify(self, kind: str, title: str, text: str) -> None:
        """Show a message on every page that is open."""
        seconds = 15.0 if kind == "error" else 6.0
        for client in self.server.get_clients().values():
            client.add_notification(title, text, auto_close_seconds=seconds, color=COLOURS[kind])

    @contextlib.contextmanager
    def reporting(self) -> Iterator[None]:
        """Turn every error inside into a message on the page."""
        try:
            yield
        except FaceanimError as error:
            self.notify("error", "That did not work", str(error))
        except Exception as error:
            self.notify("error", "That did not work", f"unexpected {type(error).__name__}: {error}")

    def toggle_recording(self) -> None:
        """Start to record, or stop and write the frames."""
        if self.recorder.running:
            self.recorder.stop()
        else:
            folder = self.recorder.start(self.simulation.setup)
            self.live.record.label = "Stop recording"
            self.notify("info", "Recording", f"into {folder}")

    def _recorded(self, kind: str, text: str, share: float) -> None:
        """Show how far the pictures of a recording are."""
        self.live.record.label = "Stop recording" if self.recorder.running else "Record"
        self.live.record.disabled = kind == "drawing"
        self.live.progress.visible = kind == "drawing"
        self.live.progress.value = 100.0 * share
        if kind in ("done", "error"):
            self.notify(kind, "Recording", text)
            self._look()

    def _tell(self) -> None:
        while not self._closing.wait(STATUS_EVERY):
            with contextlib.suppress(RuntimeError):
                self.live.status.content = self.status()

    def status(self) -> str:
        """Return the line of figures."""
        if self._moment is None or self._preparing:
            return f"Preparing {self._preparing} ..."
        moment = self._moment
        words = [f"**{self.simulation.rate:.0f}** updates/s", f"**{1e3 * moment.seconds:.1f}** ms per step"]
        words.append(f"{moment.report.iterations} iterations")
        if self.recorder.running:
            words.append(f"recording frame {self.recorder.count}")
        return " · ".join(words)

    def wait(self) -> None:
        """Wait until interrupted."""
        while True:
            sleep(3600.0)


def own_page(headers: Mapping[str, str], host: str) -> bool:
    """Return whether a connection with these HTTP `headers` comes from a page that the server at `host` has sent.

    What is no browser says no origin and is let in.
    """
    origin = headers.get("Origin")
    if origin is None:
        return True
    own = urlsplit(origin)
    local = host not in ("127.0.0.1", "localhost", "::1") or own.hostname in ("127.0.0.1", "localhost", "::1")
    return local and own.netloc == headers.get("Host")


def check_place(host: str, port: int) -> None:
    """Raise `UserError` unless a server can listen at `host`:`port`, naming a port that is free."""
    import socket

    from faceanim.ground.errors import UserError

    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError):
        raise UserError(f"--host {host!r} is not an address of this machine; use 127.0.0.1") from None
    for candidate in range(port, min(port + 100, 65_536)):
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address[0], candidate))
            except PermissionError:
                raise UserError(f"--port {port}: ports below 1024 are reserved; use 8080") from None
            except OSError as error:
                if error.errno == 99:
                    raise UserError(f"--host {host!r} is not an address of this machine; use 127.0.0.1") from None
                continue
        if candidate == port:
            return
        raise UserError(f"port {port} is in use; port {candidate} is free: --port {candidate}, or --port 0 for any")
    raise RunError(f"ports {port} to {port + 99} are all in use; choose another --port")
