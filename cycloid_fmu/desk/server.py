"""The desk as a page in the browser, which requests the results for the values in its fields and saves the values."""

from __future__ import annotations

import json
import os
import secrets
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cycloid_fmu import edge
from cycloid_fmu.desk.view import FIELDS, Desk, View, look, open_desk, pair_of, placed
from cycloid_fmu.edge.page_server import PageHandler, PageServer
from cycloid_fmu.geometry.pair import write_pair

_MOST_BYTES = 1 << 16  # of a request
_ANSWER_SECONDS = 120.0  # for large drives on slow machines


def save(
    desk: Desk, values: Mapping[str, str], folder: str | os.PathLike[str], name: str, overwrite: bool = False
) -> str | None:
    """Write the pair with the fields' values to a file in the desk's folder; never a partial file.

    Parameters
    ----------
    desk, values
        As for `look`.
    folder, name
        Folder and name of the file; the name has no folder in it and ends in `.toml`.
    overwrite
        Whether a file of this name may be replaced.

    Returns
    -------
    question
        The question to confirm before an existing file is replaced; None if the pair was written.

    Raises
    ------
    edge.InputError
        If a value or the name is invalid, or the file can't be written.
    """
    pair = pair_of(desk, values)
    # A leading dot hides a file; on Windows a colon separates a stream or drive.
    if not name.isprintable() or name.startswith(".") or any(c in name for c in '/\\:*?"<>|'):
        raise edge.ArgumentError("file name", 'write a name without folders, such as "pair-2.toml"', name)
    target = edge.output_path(Path(folder) / name, "file name", (".toml",))
    if target.exists() and not overwrite:
        return f'"{name}" exists. Overwrite it? Comments in it are lost.'
    write_pair(pair, target)
    return None


class DeskServer(PageServer):
    """Server of the page and its requests, on this machine only; it serves from its creation and is a context manager.

    Parameters
    ----------
    path
        The pair file; others are saved in its folder.
    limits
        A requirements file, or None.

    Raises
    ------
    edge.InputError
        If a file can't be read or is invalid.
    """

    def __init__(self, path: str | os.PathLike[str], limits: str | os.PathLike[str] | None = None) -> None:
        self.desk, self.path = open_desk(path, limits), Path(path)
        self.busy = threading.Lock()  # solving takes all cores
        self.first = look(self.desk, self.desk.values)  # compiles or loads the kernels before the first request
        super().__init__(_Handler, "127.0.0.1", 0, secrets.token_urlsafe(16))


class _Handler(PageHandler):
    server: DeskServer
    package = "cycloid_fmu.desk"
    name = "cycloid-fmu"

    def answer(self, path: str) -> bool:
        """Answer with the initial data of the page."""
        desk = self.server.desk
        if path != "/start":
            return False
        self._json(
            {
                "source": desk.source,
                "name": self.server.path.name,
                "fields": [one._asdict() for one in FIELDS.values()],
                "values": desk.values,
                "kept": desk.kept,
                "view": self.server.first.numbers(),
            }
        )
        return True

    def do_POST(self) -> None:  # noqa: N802 - the name that http.server calls
        """Answer with the results for values, or save them."""
        path = self.welcome()
        if path is None:
            return
        if path not in ("/look", "/save"):
            self.send_error(404)
            return
        asked = self._asked()
        if asked is None:
            return
        self.server.keep(self.connection, _ANSWER_SECONDS)
        with self.server.busy:
            self._json(self._look(asked) if path == "/look" else self._save(asked))

    def _asked(self) -> dict[str, Any] | None:
        """Return the data of a request; None if it was refused."""
        length = self.headers.get("Content-Length") or ""
        if not (length.isascii() and length.isdecimal()):
            self.send_error(411)
        elif len(length) > 9 or int(length) > _MOST_BYTES:
            self.send_error(413)
        else:
            try:
                asked = json.loads(self.rfile.read(int(length)))
            except (ValueError, RecursionError):
                asked = None
            if isinstance(asked, dict) and _is_text(asked.get("values")) and isinstance(asked.get("name", ""), str):
                return asked
            self.send_error(400)
        return None

    def _look(self, asked: dict[str, Any]) -> dict[str, Any]:
        try:
            return look(self.server.desk, asked["values"]).numbers()
        except Exception as problem:  # the page must show why it does not change
            return View({"": f"Failed: {type(problem).__name__}: {problem}"}).numbers()

    def _save(self, asked: dict[str, Any]) -> dict[str, Any]:
        name, desk = asked.get("name", ""), self.server.desk
        try:
            question = save(desk, asked["values"], self.server.path.parent, name, asked.get("overwrite") is True)
        except edge.ArgumentError as problem:
            return {"problem": str(problem)}
        except edge.InputError as problem:
            return {"problem": " ".join(placed(desk, problem).values())}
        except OSError as problem:  # a full disk, or an invalid name on this system
            return {"problem": f"{name}: this can't be written: {problem.strerror or problem}."}
        return {"question": question} if question else {"saved": f"{name} is saved."}

    def _json(self, data: dict[str, Any]) -> None:
        self.send(edge.json_text(data).encode(), "application/json; charset=utf-8")


def _is_text(values: object) -> bool:
    return isinstance(values, dict) and all(isinstance(text, str) and len(text) <= 1000 for text in values.values())
