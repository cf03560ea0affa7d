"""Control of a page in Firefox with WebDriver BiDi, without a driver process."""

import itertools
import json
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

_OPTIONS = ("--headless", "--no-remote", "--remote-debugging-port=0", "--profile")
_TIMEOUT = 60.0


class Tab:
    """Page in a browser."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._numbers = socket, itertools.count(1)
        self._call("session.new", capabilities={})
        self._context = self._call("browsingContext.getTree")["contexts"][0]["context"]

    def open(self, address: str) -> None:
        """Load a page and wait until it is complete."""
        self._call("browsingContext.navigate", context=self._context, url=address, wait="complete")

    def evaluate(self, function: str, *arguments: object) -> Any:
        """Call a JavaScript function, wait for its promise, and return the result; values are converted by JSON."""
        text = ", ".join(map(json.dumps, arguments))
        expression = f"(async () => JSON.stringify(await ({function})({text})))()"
        response = self._call(
            "script.evaluate", expression=expression, target={"context": self._context}, awaitPromise=True
        )
        assert response["type"] == "success", response["exceptionDetails"]["text"]
        return json.loads(response["result"]["value"])

    def _call(self, method: str, **parameters: object) -> dict[str, Any]:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while (message := json.loads(self._socket.recv(_TIMEOUT))).get("id") != number:
            pass
        assert message["type"] == "success", message
        result: dict[str, Any] = message["result"]
        return result


@contextmanager
def opened_firefox(program: str, profile: Path) -> Iterator[Tab]:
    """Open a tab of a separate Firefox with an empty `profile`."""
    process = subprocess.Popen([program, *_OPTIONS, str(profile)], stderr=subprocess.PIPE, text=True)
    try:
        lines = (re.search(r"WebDriver BiDi listening on (ws://\S+)", line) for line in process.stderr)
        address = next(match[1] for match in lines if match)
        with connect(f"{address}/session", max_size=2**26) as socket:
            yield Tab(socket)
    finally:
        process.terminate()
        process.communicate()
