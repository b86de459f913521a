"""What deploys hostlens is valid by its own tools, and speaks of settings and commands that there are."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import typer
import yaml

from service.cli import app
from service.dispatcher.nursery import ONE_THREAD
from service.settings import Settings
from service.store.database import Database
from service.store.grids import GridStore
from tests.deploy.compose import COMPOSE, ROOT, services
from tests.service.conftest import new_database
from tests.service.plans import submit
from tests.service.service_process import eventually, free_port

DEPLOY = ROOT / "deploy"
MANIFESTS = sorted((DEPLOY / "kubernetes").glob("*.yaml"))
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
JOBS = sorted((DEPLOY / "slurm").glob("*.sbatch"))
PROGRAMS = Path(sys.executable).parent
# Of the files themselves, not of hostlens.
OWN = {"HOSTLENS_DB_PASSWORD", "HOSTLENS_TAG", "HOSTLENS_SHARED", "HOSTLENS_SCHEDULER_HOST", "HOSTLENS_SCHEDULER_PORT"}


def text_files() -> list[Path]:
    return [path for path in sorted(DEPLOY.rglob("*")) if path.is_file()]


def resources() -> list[dict[str, Any]]:
    """What kustomize would apply, image tags and all else as in the files."""
    listed = yaml.safe_load((DEPLOY / "kubernetes" / "kustomization.yaml").read_text())["resources"]
    assert sorted([*listed, "kustomization.yaml"]) == [path.name for path in MANIFESTS]
    return [found for name in listed for found in yaml.safe_load_all((DEPLOY / "kubernetes" / name).read_text())]


def deployments() -> dict[str, dict[str, Any]]:
    return {found["metadata"]["name"]: found["spec"] for found in resources() if found["kind"] == "Deployment"}


def pods() -> Iterator[tuple[str, dict[str, Any]]]:
    for name, deployment in deployments().items():
        yield name, deployment["template"]["spec"]


def containers() -> Iterator[dict[str, Any]]:
    for _, pod in pods():
        yield from (*pod.get("initContainers", ()), *pod["containers"])


def commands() -> set[str]:
    """First words that ``hostlens`` knows."""
    group = typer.main.get_command(app)
    return set(group.commands)  # type: ignore[attr-defined]


def test_the_dockerfile_passes_its_linter_and_ends_as_another_user_than_root() -> None:
    dockerfile = DEPLOY / "Dockerfile"
    checked = subprocess.run([PROGRAMS / "hadolint", dockerfile], capture_output=True, text=True, check=False)
    assert (checked.returncode, checked.stdout) == (0, "")
    written = dockerfile.read_text()
    assert written.count("\nFROM ") == 2
    assert re.findall(r"^USER (.*)$", written, re.M) == ["10001:10001"]
    assert "HEALTHCHECK" in written
    assert {f"{name}=1" for name in ONE_THREAD} <= set(written.split())
    # Without these the build context would lack them, or carry data and environments along.
    ignored = (DEPLOY / "Dockerfile.dockerignore").read_text().split()
    assert ignored[0] == "*"
    copied = {part for line in re.findall(r"^COPY (?!--from)(.*) \S+$", written, re.M) for part in line.split()}
    assert {f"!{part}" for part in copied} <= set(ignored)
    assert all((ROOT / part).exists() for part in copied)


def test_the_compose_file_fits_the_compose_specification() -> None:
    checked = [PROGRAMS / "check-jsonschema", "--builtin-schema", "vendor.compose-spec", COMPOSE]
    subprocess.run(checked, check=True, capture_output=True)
    found = services({"HOSTLENS_DB_PASSWORD": "x"})
    ours = {name: service for name, service in found.items() if name != "postgres"}
    assert len({service["image"] for service in ours.values()}) == 1
    assert all(service["read_only"] and service["cap_drop"] == ["ALL"] for service in ours.values())
    assert "PGPASSWORD" not in {**found["worker"]["environment"], **found["scheduler"]["environment"]}
    # Only the API is published, and to this machine alone.
    published = {name: service["ports"] for name, service in found.items() if "ports" in service}
    assert published == {"api": ["127.0.0.1:8421:8421"]}


def test_the_password_of_the_compose_file_has_to_be_chosen() -> None:
    with pytest.raises(KeyError, match="HOSTLENS_DB_PASSWORD"):
        services({})
    assert "HOSTLENS_DB_PASSWORD=" in (DEPLOY / "compose" / ".env.example").read_text()


def test_the_manifests_fit_the_schemas_of_kubernetes() -> None:
    found = resources()
    for resource in found:
        kubernetes_validate.validate(resource, "1.35", strict=True)
    kinds = {resource["kind"] for resource in found}
    assert {"Deployment", "Service", "PodDisruptionBudget", "ConfigMap", "NetworkPolicy"} <= kinds
    # By reference: no secret lies here.
    assert "Secret" not in kinds


@pytest.mark.skipif(shutil.which("kubectl") is None, reason="kubectl is not installed; the schemas are checked anyway")
def test_kustomize_puts_the_manifests_together() -> None:
    built = subprocess.run(
        ["kubectl", "kustomize", DEPLOY / "kubernetes"],  # noqa: S607 - wherever it is installed
        check=True,
        capture_output=True,
        text=True,
    )
    assert len(list(yaml.safe_load_all(built.stdout))) == len(resources())


def test_no_container_of_the_manifests_is_root_or_without_limits() -> None:
    for name, pod in pods():
        assert pod["securityContext"]["runAsNonRoot"], name
        assert pod["automountServiceAccountToken"] is False, name
        assert pod["enableServiceLinks"] is False, name
        assert all("livenessProbe" in container for container in pod["containers"]), name
    for container in containers():
        assert container["securityContext"]["readOnlyRootFilesystem"]
        assert container["securityContext"]["allowPrivilegeEscalation"] is False
        assert container["resources"]["requests"]
        assert container["resources"]["limits"]["memory"]
        volumes = {mount["name"] for mount in container["volumeMounts"]}
        assert {"data", "tmp"} <= volumes


def test_services_budgets_and_policies_of_the_manifests_find_their_pods() -> None:
    labels = [deployment["template"]["metadata"]["labels"] for deployment in deployments().values()]
    for resource in resources():
        if resource["kind"] == "Service":
            wanted = resource["spec"]["selector"]
        elif resource["kind"] == "PodDisruptionBudget":
            wanted = resource["spec"]["selector"]["matchLabels"]
        else:
            continue
        assert any(wanted.items() <= found.items() for found in labels), resource["metadata"]["name"]


def test_every_command_and_setting_that_is_named_exists() -> None:
    settings = {f"HOSTLENS_{name.upper()}" for name in Settings.model_fields}
    for path in text_files():
        written = path.read_text(encoding="utf-8")
        # A name that goes on is a family, as HOSTLENS_SLURM_*.
        named = set(re.findall(r"HOSTLENS_[A-Z][A-Z_]*[A-Z](?![A-Z_*])", written))
        assert named <= settings | OWN, (path.name, named - settings - OWN)
    started = [container["command"] for container in containers()]
    started += [
        service["command"] for name, service in services({"HOSTLENS_DB_PASSWORD": "x"}).items() if name != "postgres"
    ]
    for unit in UNITS:
        lines = re.findall(r"^ExecStart(?:Pre)?=/opt/hostlens/venv/bin/(.*)$", unit.read_text(), re.M)
        assert lines
        started += [line.split() for line in lines]
    for program, first, *_ in started:
        assert program == "hostlens"
        assert first in commands()


@pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed (package systemd)"
)
def test_systemd_accepts_the_units_and_finds_them_little_exposed(tmp_path: Path) -> None:
    program = tmp_path / "venv" / "bin" / "hostlens"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    copies = []
    for unit in UNITS:
        # A template is checked by one of its instances.
        copy = tmp_path / unit.name.replace("@.", "@1.")
        copy.write_text(unit.read_text().replace("/opt/hostlens/venv", str(tmp_path / "venv")))
        copies.append(str(copy))
    verify = ["systemd-analyze", "verify", "--man=no", *copies]
    checked = subprocess.run(verify, capture_output=True, text=True, check=False)
    assert (checked.returncode, checked.stderr) == (0, "")
    # systemd's own scale from 0 to 10, threshold in tenths; a unit without any of the options has 9.6.
    for copy in copies:
        judge = ["systemd-analyze", "security", "--offline=true", "--threshold=20", copy]
        judged = subprocess.run(judge, capture_output=True, text=True, check=False)
        assert judged.returncode == 0, judged.stdout[-300:]


@pytest.mark.parametrize("job", JOBS, ids=lambda job: job.name)
def test_slurm_jobs_are_scripts_whose_options_come_first(job: Path) -> None:
    subprocess.run(["bash", "-n", job], check=True)  # noqa: S607 - as Slurm does
    lines = job.read_text().splitlines()
    assert lines[0] == "#!/bin/bash"
    options = [place for place, line in enumerate(lines) if line.startswith("#SBATCH")]
    first_command = next(place for place, line in enumerate(lines) if line and not line.startswith("#"))
    # Slurm stops reading options at the first command.
    assert options
    assert max(options) < first_command


@pytest.mark.postgres
def test_the_slurm_jobs_run_a_grid_where_srun_starts_one_task_here(tmp_path: Path, postgres_server: str) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    stubs = {
        "hostlens": f'exec {sys.executable} -m service "$@"',
        # Slurm's own would start one for each task of the job.
        "srun": 'while [ "${1#--}" != "$1" ]; do shift; done; exec "$@"',
    }
    for name, script in stubs.items():
        (programs / name).write_text(f"#!/bin/sh\n{script}\n")
        (programs / name).chmod(0o755)
    (tmp_path / "shared").mkdir()
    url = new_database(postgres_server, f"slurm_{os.getpid()}")
    environment = {
        **os.environ,
        "PATH": f"{programs}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "TMPDIR": str(tmp_path),
        "HOSTLENS_DATABASE_URL": url,
        "HOSTLENS_SHARED": str(tmp_path / "shared"),
        "HOSTLENS_SCHEDULER_HOST": "127.0.0.1",
        "HOSTLENS_SCHEDULER_PORT": str(free_port()),
        "HOSTLENS_TASK": "tests.service.tasks:fast",
    }

    def start(job: str, number: int) -> subprocess.Popen[bytes]:
        with (tmp_path / f"{job}.log").open("wb") as log:
            return subprocess.Popen(
                ["bash", DEPLOY / "slurm" / f"{job}.sbatch"],  # noqa: S607 - as Slurm does
                env={**environment, "SLURM_JOB_ID": str(number)},
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    jobs = [start("hostlens-dispatcher", 1)]
    database = Database(url)
    try:
        eventually((tmp_path / "shared" / "scheduler").exists, 60, "the scheduler's address")
        jobs.append(start("hostlens-workers", 2))
        grids = GridStore(database)
        grid_id = submit(grids, 4)
        eventually(lambda: grids.grid(grid_id).finished_at, 60, "the end of the grid")
        assert grids.grid(grid_id).counts.done == 4
        jobs[0].send_signal(signal.SIGTERM)
        jobs[0].wait(timeout=30)
    except BaseException:
        print(*(log.read_text()[-3000:] for log in tmp_path.glob("*.log")), sep="\n")
        raise
    finally:
        database.close()
        for job in jobs:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(job.pid, signal.SIGKILL)
            job.wait(timeout=20)
