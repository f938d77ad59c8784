"""A server that takes connections and never answers: what must not be asked anything."""

import socket
import threading


class MuteServer:
    """Listens on this machine; `calls` counts who came."""

    def __init__(self) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._socket.getsockname()[1]}/dem.tif"
        self.calls = 0
        self._held: list[socket.socket] = []
        threading.Thread(target=self._take, daemon=True).start()

    def _take(self) -> None:
        while True:
            try:
                self._held.append(self._socket.accept()[0])
            except OSError:
                return
            self.calls += 1

    def close(self) -> None:
        self._socket.close()
        for held in self._held:
            held.close()
