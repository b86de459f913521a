"""What deploys hostlens is valid by its own tools, and speaks of settings and commands that there are."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
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

from service.cli.app import app
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.grids import GridStore
from service.worker.fork_server import ONE_THREAD
from tests.deploy.compose import COMPOSE, ROOT, services
from tests.service.conftest import new_database
from tests.service.plans import submit
from tests.service.service_process import eventually, free_port

DEPLOY = ROOT / "deploy"
MIGRATE = DEPLOY / "kubernetes" / "migrate"
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


def migration() -> dict[str, Any]:
    """The job that is applied before the rest."""
    assert yaml.safe_load((MIGRATE / "kustomization.yaml").read_text())["resources"] == ["job.yaml"]
    return dict(yaml.safe_load((MIGRATE / "job.yaml").read_text()))


def deployments() -> dict[str, dict[str, Any]]:
    return {found["metadata"]["name"]: found["spec"] for found in resources() if found["kind"] == "Deployment"}


def pods() -> Iterator[tuple[str, dict[str, Any]]]:
    for name, deployment in deployments().items():
        yield name, deployment["template"]["spec"]
    yield "hostlens-migrate", migration()["spec"]["template"]["spec"]


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
    assert len(re.findall("^FROM ", written, re.M)) == 2
    assert re.findall(r"^USER (.*)$", written, re.M) == ["10001:10001"]
    assert "HEALTHCHECK" in written
    # A version and a distribution, not what happens to be the latest today.
    images = re.findall(r"^FROM (\S+)", written, re.M)
    assert all(re.fullmatch(r"python:3\.11\.\d+-slim-[a-z]+", image) for image in images), images
    assert len(set(images)) == 1
    images = [service["image"] for service in services({"HOSTLENS_DB_PASSWORD": "x"}).values()]
    assert all(re.fullmatch(r"hostlens:.*|postgres:\d+\.\d+-[a-z]+", image) for image in images), images
    # Dependencies lie in a layer that a change of the sources leaves as it is; kernels are compiled by the build.
    build = written.rpartition("\nFROM ")[0]
    steps = [build.index(step) for step in ("-r requirements.txt", "COPY engine", "--no-deps wheels", "warm_up()")]
    assert steps == sorted(steps)
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
    found = [*resources(), migration()]
    for resource in found:
        kubernetes_validate.validate(resource, "1.35", strict=True)
    kinds = {resource["kind"] for resource in found}
    assert {"Job", "Deployment", "Service", "PodDisruptionBudget", "ConfigMap", "NetworkPolicy"} <= kinds
    # By reference: no secret lies here.
    assert "Secret" not in kinds


@pytest.mark.skipif(shutil.which("kubectl") is None, reason="kubectl is not installed; the schemas are checked anyway")
def test_kustomize_puts_the_manifests_together() -> None:
    for folder, number in ((DEPLOY / "kubernetes", len(resources())), (MIGRATE, 1)):
        built = subprocess.run(
            ["kubectl", "kustomize", folder],  # noqa: S607 - wherever it is installed
            check=True,
            capture_output=True,
            text=True,
        )
        assert len(list(yaml.safe_load_all(built.stdout))) == number


def test_the_database_is_migrated_by_a_job_and_by_no_pod_that_stays() -> None:
    job = migration()["spec"]
    (container,) = job["template"]["spec"]["containers"]
    assert container["command"] == ["hostlens", "db", "upgrade"]
    (rule,) = job["podFailurePolicy"]["rules"]
    # A setting that is not acceptable is no reason to try again.
    assert (rule["action"], rule["onExitCodes"]["values"]) == ("FailJob", [2])
    for deployment in deployments().values():
        assert "initContainers" not in deployment["template"]["spec"]


def test_two_versions_of_the_dispatcher_or_of_the_scheduler_never_run_at_once() -> None:
    for name in ("hostlens-dispatcher", "hostlens-scheduler"):
        assert deployments()[name]["strategy"] == {"type": "Recreate"}


def test_liveness_asks_the_process_alone_and_starts_are_waited_for() -> None:
    for name, deployment in deployments().items():
        (container,) = deployment["template"]["spec"]["containers"]
        alive, start = container["livenessProbe"], container["startupProbe"]
        assert alive["httpGet"]["path"] in {"/healthz", "/health", "/metrics"}, name
        # The API's counts its database at /metrics.
        assert name != "hostlens-api" or alive["httpGet"]["path"] == "/healthz"
        # Two minutes and more: to load everything takes seconds, but half a minute on a machine that is overloaded.
        assert start["periodSeconds"] * start["failureThreshold"] >= 120, name
        # A minute of silence, not one lost answer.
        assert alive["periodSeconds"] * alive.get("failureThreshold", 3) >= 30, name
    (api,) = deployments()["hostlens-api"]["template"]["spec"]["containers"]
    assert api["readinessProbe"]["httpGet"]["path"] == "/readyz"


def test_workers_and_schedulers_are_never_told_the_password_of_the_database() -> None:
    for name in ("hostlens-worker", "hostlens-scheduler"):
        (container,) = deployments()[name]["template"]["spec"]["containers"]
        assert "secretKeyRef" not in str(container), name
    for unit in UNITS:
        read = re.findall(r"^EnvironmentFile=-?(.*)$", unit.read_text(), re.M)
        sees_it = unit.name in {"hostlens-api.service", "hostlens-dispatcher.service"}
        assert read == ["/etc/hostlens.env", "/etc/hostlens-database.env"][: 2 if sees_it else 1], unit.name
    common, secret = re.findall(r"```sh\n((?:[A-Z_]+=.*\n)+)```", (DEPLOY / "systemd" / "README.md").read_text())
    assert "PASSWORD" not in common
    assert "DATABASE" not in common
    assert "PGPASSWORD" in secret


def test_units_try_for_ever_but_not_with_a_setting_that_is_not_acceptable() -> None:
    for unit in UNITS:
        options = dict(line.split("=", 1) for line in unit.read_text().splitlines() if "=" in line and line[0] != "#")
        assert options["StartLimitIntervalSec"] == "0", unit.name
        assert options["RestartPreventExitStatus"] == "2", unit.name
        assert options["Restart"] in {"always", "on-failure"}, unit.name
        # systemd looks at the exit code of the main process alone, and ends what comes before it after 90 s.
        assert "ExecStartPre" not in options, unit.name


@pytest.mark.parametrize("name", ["hostlens-api.service", "hostlens-dispatcher.service"])
def test_a_unit_migrates_first_and_passes_on_how_that_ended(name: str, tmp_path: Path) -> None:
    (command,) = re.findall(r"^ExecStart=(.*)$", (DEPLOY / "systemd" / name).read_text(), re.M)
    program, log = tmp_path / "hostlens", tmp_path / "log"
    program.write_text(f'#!/bin/sh\necho "$*" >> {log}\n[ "$1" != db ] || exit $(cat {tmp_path}/code)\n')
    program.chmod(0o755)
    line = shlex.split(command.replace("/opt/hostlens/venv/bin/hostlens", str(program)))
    service = name.removeprefix("hostlens-").removesuffix(".service")
    for code, ran in ((0, ["db upgrade", service]), (1, ["db upgrade"]), (2, ["db upgrade"])):
        (tmp_path / "code").write_text(str(code))
        log.unlink(missing_ok=True)
        assert subprocess.run(line, check=False).returncode == code
        assert log.read_text().splitlines() == ran


def test_no_container_of_the_manifests_is_root_or_without_limits() -> None:
    for name, pod in pods():
        assert pod["securityContext"]["runAsNonRoot"], name
        assert pod["automountServiceAccountToken"] is False, name
        assert pod["enableServiceLinks"] is False, name
        ends_by_itself = pod.get("restartPolicy") == "Never"
        assert all(ends_by_itself or "livenessProbe" in container for container in pod["containers"]), name
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
        lines = re.findall(r"/opt/hostlens/venv/bin/(hostlens [a-z -]+)", unit.read_text())
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


def stub(folder: Path, name: str, script: str) -> None:
    (folder / name).write_text(f"#!/bin/bash\n{script}\n")
    (folder / name).chmod(0o755)


_LONG_PROCESS = """
[ "$1" = db ] && exit
trap 'trap "" TERM; echo "$1 told" >> $LOG; [ "$1" = scheduler ] || sleep 1; echo "$1 ended" >> $LOG; exit 0' TERM
echo "$1 started" >> $LOG
while [ ! -e "$LOG.$1" ]; do sleep 0.05; done
exit 7
"""
"""Of hostlens: ends a second after it is told to, or by itself with 7."""


@pytest.mark.parametrize("cause", ["told", "told twice", "scheduler", "dispatcher"])
def test_the_slurm_job_waits_for_the_dispatcher_before_it_stops_the_scheduler(cause: str, tmp_path: Path) -> None:
    log = tmp_path / "log"
    stub(tmp_path, "hostlens", _LONG_PROCESS)
    environment = {
        **os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "LOG": str(log), "SLURM_JOB_ID": "1",
        "HOSTLENS_DATABASE_URL": "postgresql://x/y", "HOSTLENS_SHARED": str(tmp_path),
    }  # fmt: skip
    job = subprocess.Popen(["bash", DEPLOY / "slurm" / "hostlens-dispatcher.sbatch"], env=environment)  # noqa: S607

    def said() -> list[str]:
        return log.read_text().splitlines() if log.exists() else []

    try:
        eventually(lambda: len(said()) == 2 and (tmp_path / "scheduler").exists(), what="a start of both")
        if cause.startswith("told"):
            job.send_signal(signal.SIGTERM)
        else:
            Path(f"{log}.{cause}").touch()
        if cause == "told twice":
            eventually(lambda: "dispatcher told" in said(), what="the dispatcher is told")
            job.send_signal(signal.SIGTERM)
        code = job.wait(timeout=120)
    finally:
        job.kill()
    both = ["dispatcher told", "dispatcher ended", "scheduler told", "scheduler ended"]
    expected = {"scheduler": both[:2], "dispatcher": both[2:]}.get(cause, both)
    assert said()[2:] == expected
    assert code == (0 if cause.startswith("told") else 7)


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
        stub(programs, name, script)
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
        eventually((tmp_path / "shared" / "scheduler").exists, what="the scheduler's address")
        jobs.append(start("hostlens-workers", 2))
        grids = GridStore(database)
        grid_id = submit(grids, 4)
        eventually(lambda: grids.grid(grid_id).finished_at, what="the end of the grid")
        assert grids.grid(grid_id).counts.done == 4
        jobs[0].send_signal(signal.SIGTERM)
        assert jobs[0].wait(timeout=120) == 0
    except BaseException:
        print(*(log.read_text()[-3000:] for log in tmp_path.glob("*.log")), sep="\n")
        raise
    finally:
        database.close()
        for job in jobs:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(job.pid, signal.SIGKILL)
            job.wait(timeout=120)
