"""Sweeps: resuming with the same command, folders, processes, launchers, experiments."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from meshspiral.commands.train import train_separately
from meshspiral.experiment.run_folder import (
    BEST,
    CONFIG,
    LAST,
    METRICS,
    RunError,
    Stopped,
    write_metrics,
)
from meshspiral.experiment.runs import InUse, alone, claim
from meshspiral.experiment.sweeps import (
    FAILED,
    invocation,
    job_states,
    number_unfinished,
    run_folder,
    sweep_folder,
)
from meshspiral.training.callbacks import GracefulStop
from tests import helpers
from tests.helpers import QUICK, ROOT, composed, program_process, run, wait_for, weights

SWEEP = ["-m", "seed=0,1,2", "optim.epochs=12"]


def test_a_killed_sweep_resumes_with_the_unfinished_jobs(cli, toy_overrides, tmp_path):
    toy = [o for o in toy_overrides if not o.startswith("optim")]
    command = [*SWEEP, *toy]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-m", "src.train", *command],
        cwd=tmp_path,
        env=env,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    end = time.monotonic() + 120
    while not (second := list((tmp_path / "outputs/sweeps").glob(f"*/seed-1/{LAST}"))):
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    sweep = second[0].parents[2]
    assert [(job, state) for job, state, _ in job_states(sweep)] == [
        ("seed-0", "finished"),
        ("seed-1", "stopped"),
    ]
    first = (sweep / "seed-0" / METRICS).stat().st_mtime_ns

    code, out, err = cli(*command)
    assert code == 0, err
    assert [state for _, state, _ in job_states(sweep)] == 3 * ["finished"]
    assert (sweep / "seed-0" / METRICS).stat().st_mtime_ns == first
    assert (
        "already finished: " in out
        and f"python -m src.report runs={sweep.relative_to(tmp_path)}" in out
    )

    more = [word.replace("0,1,2", "0,1,2,3") for word in command]
    code, out, err = cli(*more, f"hydra.sweep.dir={sweep}")
    assert code == 0, err
    assert [job for job, *_ in job_states(sweep)] == ["seed-0", "seed-1", "seed-2", "seed-3"]
    assert (sweep / "seed-0" / METRICS).stat().st_mtime_ns == first

    uninterrupted = tmp_path / "uninterrupted"
    run(uninterrupted, [*toy, "optim.epochs=12", "seed=1"])
    resumed, expected = weights(sweep / "seed-1"), weights(uninterrupted)
    assert all((resumed[key] == expected[key]).all() for key in expected)


def test_a_failed_job_is_listed_and_retried(cli, toy_overrides, monkeypatch):
    command = ["-m", "data.shot.bins=4,5", *toy_overrides, *QUICK]
    command = [word for word in command if word != "data.shot.bins=4"]
    from meshspiral.data import preprocessing

    real = preprocessing._described

    def fails(descriptor, *inputs):
        if descriptor.settings.bins == 5:
            raise RuntimeError("out of ink")
        return real(descriptor, *inputs)

    with monkeypatch.context() as broken:
        broken.setattr(preprocessing, "_described", fails)
        code, out, _ = cli(*command)
    assert code == 1
    [sweep] = Path("outputs/sweeps").iterdir()
    assert [row[:2] for row in job_states(sweep)] == [
        ("data.shot.bins-4", "finished"),
        ("data.shot.bins-5", "failed"),
    ]
    assert "failed    RuntimeError('out of ink')" in out
    assert "Traceback" in (sweep / "data.shot.bins-5" / "train.log").read_text()
    code, out, err = cli(*command)
    assert code == 0, err
    assert not (sweep / "data.shot.bins-5" / FAILED).exists()
    assert [state for _, state, _ in job_states(sweep)] == 2 * ["finished"]


def test_runs_started_in_the_same_second_get_different_folders(tmp_path):
    new = str(tmp_path / "12-00-00_fcs")
    with invocation([]):
        first = run_folder(None, new)
        assert first == new == run_folder(None, new)  # Hydra asks again
    with invocation([]):  # another command line
        assert run_folder(None, new) == f"{new}_2"
        assert run_folder(first, new) == first


def test_the_same_command_gives_the_same_sweep_folder():
    def folder(*words):
        with invocation(list(words)):
            return sweep_folder()

    one = folder("-m", "seed=0,1", "+metric=true")
    assert one == folder("--multirun", "seed=0,1", "+metric=true", "hydra.job.name=x")
    assert one.startswith("seed-0-1_metric-true-")
    assert one != folder("-m", "seed=0-1", "+metric=true")
    assert folder("-m") == "sweep"


def test_a_sweep_with_a_stopped_job_has_not_succeeded(tmp_path):
    for name, file in (("a", METRICS), ("b", CONFIG), ("c", FAILED)):
        (tmp_path / name).mkdir()
        (tmp_path / name / CONFIG).touch()
        content = (
            '{"test/exact_match": 0, "test/geodesic_error": 0}' if file == METRICS else "reason"
        )
        (tmp_path / name / file).write_text(content)
    assert number_unfinished(tmp_path) == 2
    with alone(tmp_path / "b"):  # now it is running in another process
        assert number_unfinished(tmp_path) == 1


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_launchers_run_jobs_in_separate_processes(toy_overrides, tmp_path, launcher):
    """Two jobs share the cache and the cores; one fails, and the other renders."""
    toy = [o for o in toy_overrides if not o.startswith(("trainer.threads", "optim"))]
    command = ["-m", f"hydra/launcher={launcher}", "optim.lr=0,0.01", *toy, *QUICK]
    command = [word.replace("picture=false", "picture=true") for word in command]
    env = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-m", "src.train", *command],
        cwd=tmp_path,
        env={**env, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1, done.stderr
    [sweep] = (tmp_path / "outputs" / "sweeps").iterdir()
    if launcher == "joblib":  # one core per job
        log = (sweep / "optim.lr-0.01" / "train.log").read_text()
        assert "32-true on cpu, 1 thread\n" in log
    assert "launcher" not in sweep.name
    found = {job: state for job, state, _ in job_states(sweep)}
    assert found == {
        "optim.lr-0": "failed",
        "optim.lr-0.01": "finished",
    }
    assert "optim.lr must be above 0" in done.stdout
    assert (sweep / "optim.lr-0.01" / "correspondence.png").is_file()
    alone = tmp_path / "alone"
    run(alone, [*toy, *QUICK, "optim.lr=0.01", "trainer.threads=1"])
    trained, expected = weights(sweep / "optim.lr-0.01"), weights(alone)
    for key, value in expected.items():
        np.testing.assert_allclose(trained[key], value, atol=1e-4)


def test_two_processes_give_the_metrics_of_one(toy_overrides, tmp_path):
    """Three meshes on two processes: every mesh counts once.

    The run starts in one process. It resumes as a job of a sweep, in one task of a cluster; the
    second process must not start the sweep again.
    """
    ddp = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"]
    (tmp_path / "job").mkdir()
    claim(tmp_path / "job", composed([*toy_overrides, "optim.epochs=2"]))
    slurm = {
        "SLURM_JOB_ID": "7",
        "SLURM_JOB_NAME": "job",
        "SLURM_NTASKS": "1",
        "SLURM_NTASKS_PER_NODE": "1",
        "SLURM_PROCID": "0",
        "SLURM_LOCALID": "0",
    }
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "src.train",
            "-m",
            *toy_overrides,
            *ddp,
            "optim.epochs=2",
            f"hydra.sweep.dir={tmp_path}",
            "hydra.sweep.subdir=job",
        ],
        cwd=ROOT,
        env={**os.environ, **slurm},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("Test on 3 unseen meshes") == 1
    assert [state for _, state, _ in job_states(tmp_path)] == ["finished"]
    together = json.loads((tmp_path / "job" / METRICS).read_text())
    with pytest.raises(RunError, match="of a run in 2 processes, not 1"):
        run(tmp_path / "job", [*toy_overrides, "optim.epochs=2"])
    for path in (tmp_path / "job" / LAST, tmp_path / "job" / BEST):
        saved = torch.load(path, weights_only=True)
        del saved["processes"]
        torch.save(saved, path)
    alone = run(tmp_path / "job", [*toy_overrides, "optim.epochs=2"])  # with the same weights
    for name in sorted(helpers.METRICS - helpers.SECONDS):
        assert together[name] == pytest.approx(alone[name], rel=1e-5), name


@pytest.mark.parametrize("processes", [2])  # four: passed too, and take a minute
def test_several_processes_train_as_one_with_accumulation(toy_overrides, tmp_path, processes):
    """Meshes, neighbourhoods, dropout and steps are the same."""
    exact = ["trainer.precision=64", "model.dropout=0.3", "optim.epochs=2", "picture=false"]
    split = ["data.train=[train/0.ply,train/1.ply,train/2.ply,train/3.ply]"]
    split += ["data.val=[val/*.ply,train/4.ply]", "data.test=[test/*.ply,train/5.ply]"]
    toy = [*toy_overrides, *split, *exact]
    ddp = ["trainer=ddp", "trainer.accelerator=cpu", f"trainer.devices={processes}"]
    together, alone = tmp_path / "together", tmp_path / "alone"
    command = [sys.executable, "-m", "src.train", *ddp, *toy, f"hydra.run.dir={together}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    run(alone, [*toy, f"trainer.accumulate={processes}"])
    one, other = (
        torch.load(folder / LAST, weights_only=True)["state_dict"] for folder in (together, alone)
    )
    for name, value in one.items():
        torch.testing.assert_close(value, other[name], rtol=0, atol=1e-7)


def test_a_signal_to_one_process_of_several_stops_all(toy_overrides, tmp_path):
    ddp = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"]
    process = program_process([*toy_overrides, *ddp, "optim.epochs=500"], tmp_path)
    wait_for((tmp_path / LAST).exists, process)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=60)  # of all processes: they share the pipe
    assert process.returncode == 143 and "Traceback" not in output, output
    assert output.count(f"To resume: python -m src.train resume={tmp_path}") == 1
    torch.load(tmp_path / LAST, weights_only=True)


def test_a_signal_during_the_all_reduce_stops_at_the_next_step(tmp_path):
    stop = GracefulStop(tmp_path)

    def agree(decision, all):
        stop.signum = signal.SIGINT  # comes after this process reported no signal
        return decision

    strategy = SimpleNamespace(reduce_boolean_decision=agree)
    trainer = SimpleNamespace(
        world_size=2,
        strategy=strategy,
        num_training_batches=9,
        global_step=1,
        accumulate_grad_batches=1,
    )
    stop.on_train_batch_start(trainer, None, None, 0)
    with pytest.raises(Stopped) as stopped:
        stop.on_train_batch_start(trainer, None, None, 0)
    assert stopped.value.signum == signal.SIGINT


def test_a_job_of_another_process_is_skipped(cli, toy_overrides, tmp_path):
    command = ["-m", "seed=0,1", *toy_overrides, *QUICK]
    sweep = tmp_path / "sweep"
    (sweep / "seed-0").mkdir(parents=True)
    with alone(sweep / "seed-0"):
        code, out, err = cli(*command, f"hydra.sweep.dir={sweep}")
        assert code == 0, err
        assert "already running in another process: " in out and "seed-0  running" in out
        assert not (sweep / "seed-0" / METRICS).exists()
        assert (sweep / "seed-1" / METRICS).exists()
        code, out, err = cli(*toy_overrides, *QUICK, "seed=0", f"hydra.run.dir={sweep}/seed-0")
        assert code == 1 and "another process is training in" in out + err
    assert cli(*command, f"hydra.sweep.dir={sweep}")[0] == 0
    assert [state for _, state, _ in job_states(sweep)] == 2 * ["finished"]


def test_a_multi_process_job_that_is_already_running_has_not_failed(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", "false")  # a command that exits with 1
    with alone(tmp_path), pytest.raises(InUse):
        train_separately(tmp_path, [])
    with pytest.raises(RunError, match=r"exit code 1; the reason is in .*train\*\.log"):
        train_separately(tmp_path, [])


def test_other_settings_fail_but_finished_jobs_stay_finished(cli, toy_overrides):
    command = ["-m", "seed=0,1", *toy_overrides, "hydra.sweep.dir=sweep"]
    assert cli(*command, *QUICK)[0] == 0
    code, _, _ = cli(*command, "optim.epochs=2")
    assert code == 1
    rows = job_states(Path("sweep"))
    assert [state for _, state, _ in rows] == 2 * ["finished"]
    assert "but sweep/seed-0 holds another run, whose optim.epochs differ" in rows[0][2]
    assert cli(*command, *QUICK)[0] == 0
    assert "holds another run" not in job_states(Path("sweep"))[0][2]


@pytest.fixture
def two_at_a_time(toy_overrides, tmp_path):
    """A sweep in two processes, each past its first epoch."""
    toy = [o for o in toy_overrides if not o.startswith("optim")]
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "src.train",
            "-m",
            "hydra/launcher=joblib",
            "seed=0,1",
            *toy,
            "optim.epochs=5000",
        ],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_for(lambda: len(list(tmp_path.glob(f"outputs/sweeps/*/*/{LAST}"))) == 2, process)
    yield process
    process.kill()


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds the workers in /proc")
def test_a_killed_worker_leaves_the_table_and_a_one_line_error(two_at_a_time, tmp_path):
    pids = Path(f"/proc/{two_at_a_time.pid}/task/{two_at_a_time.pid}/children")
    children = [Path("/proc", pid) for pid in pids.read_text().split()]
    worker = next(c for c in children if "popen_loky" in (c / "cmdline").read_text())
    os.kill(int(worker.name), signal.SIGKILL)
    out, err = two_at_a_time.communicate(timeout=60)
    assert two_at_a_time.returncode == 1
    assert out.count("the same command resumes it") == 2 and "Traceback" not in err
    message = (
        r"error: a job crashed \(TerminatedWorkerError: .*; traceback in (.*)\); "
        r"rerun the same command to resume\n"
    )
    [traceback] = re.findall(message, err)
    assert "TerminatedWorkerError" in (tmp_path / traceback).read_text()


def test_ctrl_c_in_a_launcher_says_how_to_resume(two_at_a_time):
    two_at_a_time.send_signal(signal.SIGINT)
    _, err = two_at_a_time.communicate(timeout=60)
    assert two_at_a_time.returncode == 130
    assert "Stopped. To resume: rerun the same command" in err


def test_a_run_whose_plots_failed_is_not_finished(cli, toy_overrides, monkeypatch):
    def disk_full(*_):
        raise OSError(28, "No space left on device", "curve.png")

    command = ["-m", "seed=0", *toy_overrides, *QUICK]
    with monkeypatch.context() as broken:
        broken.setattr("meshspiral.evaluation.summary.write_plots", disk_full)
        assert cli(*command)[0] == 1
    [sweep] = Path("outputs/sweeps").iterdir()
    [row] = job_states(sweep)
    assert row[1:] == ("failed", "curve.png: No space left on device")
    assert cli(*command)[0] == 0
    [row] = job_states(sweep)
    assert row[1] == "finished" and (sweep / row[0] / "curve.png").is_file()


@pytest.mark.parametrize("launcher", ["joblib", "slurm", "submitit_local"])
def test_the_launchers_have_configs(cli, launcher):
    code, out, err = cli(f"hydra/launcher={launcher}", "--cfg", "hydra", "-p", "hydra.launcher")
    assert code == 0, err
    assert "_target_: hydra_plugins." in out
    assert ("max_num_timeout: 6" in out) == (launcher == "slurm")


@pytest.mark.parametrize(
    "name, jobs",
    [
        ("networks", {"model-fcs", "model-gcnn3", "model-lstm"}),
        ("rotations", {"model-fcs", "model-lstm"}),
        (
            "remeshed model=gcnn3 metric=false",
            {"data.remesh-isotropic", "data.remesh-mixed"},
        ),
        (
            "remeshed",
            {
                f"model-{m}_data.remesh-{p}_metric-{x}"
                for m in ("fcs", "lstm")
                for p in ("isotropic", "mixed")
                for x in ("true", "false")
            },
        ),
        (
            "lengths",
            {
                f"model-{m}_seq_len-{n}_metric-{x}"
                for m in ("fcs", "lstm")
                for n in (15, 20, 30)
                for x in ("true", "false")
            },
        ),
        ("parameters", {f"model-fcs_seq_len-{n}" for n in (15, 20, 30)}),
        ("parameters model=lstm,gcnn3 seq_len=30", {"model-gcnn3", "model-lstm"}),
    ],
    ids=[
        "networks",
        "rotations",
        "remeshed_gcnn3",
        "remeshed",
        "lengths",
        "parameters",
        "parameters_others",
    ],
)
@pytest.mark.parametrize("paper", [False, True])
def test_the_experiments_of_the_paper_are_sweeps(
    cli, toy_overrides, monkeypatch, name, jobs, paper
):
    """Checks their jobs, with our settings and the paper's; `train` is replaced."""
    metrics = {"test/exact_match": 0.0, "test/geodesic_error": 0.0}
    monkeypatch.setattr(
        "meshspiral.training.run.train", lambda config, folder: write_metrics(folder, metrics)
    )
    toy = [o for o in toy_overrides if not o.startswith(("seq_len", "data.shot"))]
    name, *words = name.split()
    code, _, err = cli(
        "-m", f"experiment={f'[paper,{name}]' if paper else name}", *toy, *words, *QUICK
    )
    assert code == 0, err
    [sweep] = Path("outputs/sweeps").iterdir()
    assert {(job, state) for job, state, _ in job_states(sweep)} == {
        (job, "finished") for job in jobs
    }
    configs = [OmegaConf.load(sweep / job / CONFIG) for job in jobs]
    lengths = {15, 20, 30} if any("seq_len-" in job for job in jobs) else {30}
    assert {c.seq_len for c in configs} == lengths
    assert {c.optim.lr for c in configs} == {0.001 if paper else 0.004}
    assert {c.model.dropout for c in configs} == {0.3}
    remeshed = {(c.data.remesh.policy, c.data.remesh.vertices) for c in configs if c.data.remesh}
    assert remeshed == ({("isotropic", None), ("mixed", None)} if name == "remeshed" else set())
