"""The compose file as plain processes: the same commands and settings, with this machine in place of the network."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any

import yaml

from tests.drills.installation import free_port

ROOT = Path(__file__).resolve().parents[2]
COMPOSE = ROOT / "deploy" / "compose" / "compose.yaml"
_VARIABLE = re.compile(r"\$\{(\w+)(?::-([^}]*)|:\?[^}]*)?\}")
_PORT = re.compile(r"\b(8421|8422|8786|8787|8790)\b")


def services(variables: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """The services, with variables replaced as Compose does."""

    def value(found: re.Match[str]) -> str:
        if found[1] not in variables and found[2] is None:
            raise KeyError(found[1])
        return variables.get(found[1], found[2] or "")

    document = yaml.safe_load(_VARIABLE.sub(value, COMPOSE.read_text(encoding="utf-8")))
    return dict(document["services"])


class Topology:
    """The services of the compose file on this machine, PostgreSQL excepted, which is given."""

    def __init__(self, folder: Path, database: str, **settings: str) -> None:
        self.folder = folder
        self.services = services({"HOSTLENS_DB_PASSWORD": "none needed"})
        self._database = database
        self._settings = settings
        self._shared: dict[str, int] = {}
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._stop = Event()
        self.restarts = 0

    def port(self, number: str, instance: str = "") -> int:
        """The free port that stands for a container's; those that only a container itself uses differ by instance."""
        key = number if number in {"8786", "8421"} else f"{instance} {number}"
        return self._shared.setdefault(key, free_port())

    def here(self, text: str, instance: str) -> str:
        """A command's part or a setting, for this machine."""
        text = text.replace("postgresql://hostlens@postgres:5432/hostlens", self._database)
        if text == self._database:
            return text
        text = text.replace("/var/lib/hostlens", str(self.folder / "data"))
        text = text.replace("//scheduler:", "//127.0.0.1:").replace("0.0.0.0", "127.0.0.1")  # noqa: S104 - replaced
        return _PORT.sub(lambda found: str(self.port(found[0], instance)), text)

    def start(self, name: str, instance: str) -> subprocess.Popen[bytes]:
        """Start a service as its container would."""
        service = self.services[name]
        program, *arguments = service["command"]
        assert program == "hostlens", "every container of ours runs the command line"
        stated = {key: self.here(str(value), instance) for key, value in service["environment"].items()}
        inherited = {key: value for key, value in os.environ.items() if not key.startswith("HOSTLENS_")}
        with (self.folder / f"{instance}.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "service", *(self.here(part, instance) for part in arguments)],
                cwd=self.folder,
                env={**inherited, "PYTHONPATH": str(ROOT), **stated, **self._settings},
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def healthy(self, name: str, instance: str) -> bool:
        """Whether the service's own health check passes."""
        kind, program, *arguments = self.services[name]["healthcheck"]["test"]
        assert (kind, program) == ("CMD", "python")
        check = [sys.executable, *(self.here(part, instance) for part in arguments)]
        return subprocess.run(check, capture_output=True, check=False, timeout=120).returncode == 0

    def instances(self) -> dict[str, str]:
        """Name of the service of each container that stays, those that are waited for first."""
        order = ("scheduler", "worker", "dispatcher", "api")
        assert set(order) == set(self.services) - {"postgres", "migrate"}
        return {
            f"{name}-{number}": name
            for name in order
            for number in range(self.services[name].get("deploy", {}).get("replicas", 1))
        }

    def kill(self, instance: str) -> None:
        """End a container by kill -9, with all that runs in it."""
        os.killpg(self._running[instance].pid, signal.SIGKILL)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Migrations, then all services, started again when they end, as ``restart: unless-stopped`` says."""
        migrate = self.start("migrate", "migrate")
        assert migrate.wait(timeout=120) == 0, (self.folder / "migrate.log").read_text()
        instances = self.instances()
        assert {self.services[name]["restart"] for name in instances.values()} == {"unless-stopped"}
        self._running = {instance: self.start(name, instance) for instance, name in instances.items()}
        keeper = Thread(target=self._keep, args=(instances,), name="keeper")
        keeper.start()
        try:
            yield
        except BaseException:
            for log in sorted(self.folder.glob("*.log")):
                print(f"--- {log.name}\n{log.read_text(errors='replace')[-2000:]}")
            raise
        finally:
            self._stop.set()
            keeper.join()
            for process in reversed(self._running.values()):
                process.terminate()
            for process in self._running.values():
                with suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=120)
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    def _keep(self, instances: dict[str, str]) -> None:
        while not self._stop.wait(0.2):
            for instance, process in self._running.items():
                if process.poll() is not None and not self._stop.is_set():
                    self.restarts += 1
                    self._running[instance] = self.start(instances[instance], instance)
