"""The training loop: interrupted and resumed, it takes the same steps."""

import json
import math
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch import nn

from palpate.core import PalpateError
from palpate.training import loop
from palpate.training.loop import LoopOptions, fit, learning_rate, rows_at

N = 23
STEPS = 14


class Net(nn.Module):
    """Two layers and a running mean that is no parameter, as batch norm has."""

    def __init__(self):
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(3)
            self.a, self.b = nn.Linear(5, 7), nn.Linear(7, 1)
            self.data, self.target = torch.randn(N, 5), torch.randn(N, 1)
        self.register_buffer("seen", torch.zeros(()))


def loss(module, rows, generator, step):
    x = module.data[rows] + 0.1 * torch.randn(len(rows), 5, generator=generator)
    module.seen += 1
    value = (module.b(torch.tanh(module.a(x))) - module.target[rows]).square().mean()
    return value, {"step_again": float(step)}


def options(**change):
    return LoopOptions(
        **{
            "steps": STEPS,
            "batch": 4,
            "lr": 1e-2,
            "warmup": 3,
            "ema": 0.9,
            "seed": 5,
            "checkpoint_seconds": 1e9,
            **change,
        }
    )


def weights(net):
    return {k: v.clone() for k, v in net.state_dict().items()}


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def without_time(log):
    return [{k: v for k, v in line.items() if k != "seconds"} for line in log]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    net = Net()
    log = fit(net, loss, N, options(), tmp_path_factory.mktemp("whole"))
    return weights(net), log


class StopAt:
    """Raises KeyboardInterrupt in the step given, at the place given."""

    def __init__(self, step, monkeypatch, place):
        self.step = step
        self.count = -1
        if place == "loss":
            self.loss = self._in_loss
        else:
            self.loss = loss
        self.progress = self._in_progress if place == "progress" else lambda *a: None
        if place == "update":
            real = torch.optim.AdamW.step

            def update(optimizer, *args, **kwargs):
                self.count += 1
                if self.count == step:  # half of the tensors are moved when the key is pressed
                    half = optimizer.param_groups[0]["params"][0]
                    half.data.add_(1.0)
                    raise KeyboardInterrupt
                return real(optimizer, *args, **kwargs)

            monkeypatch.setattr(torch.optim.AdamW, "step", update)
        if place == "average":
            real_lerp = torch.Tensor.lerp_

            def lerp(tensor, *args):
                self.count += 1
                if self.count == 4 * step + 2:  # four parameters a step: the average is half done
                    raise KeyboardInterrupt
                return real_lerp(tensor, *args)

            monkeypatch.setattr(torch.Tensor, "lerp_", lerp)

    def _in_loss(self, module, rows, generator, step):
        if step == self.step:
            raise KeyboardInterrupt
        return loss(module, rows, generator, step)

    def _in_progress(self, what, done, total, remark=""):
        if done == self.step + 1:
            raise KeyboardInterrupt


@pytest.mark.parametrize("place", ["loss", "update", "average", "progress"])
@pytest.mark.parametrize("step", [0, 1, 7, STEPS - 1])
@pytest.mark.parametrize("every", [1e9, 0.0])  # a checkpoint never, or after each step
def test_interrupted_and_resumed_equals_uninterrupted(tmp_path, whole, place, step, every):
    with pytest.MonkeyPatch.context() as patch:
        stop = StopAt(step, patch, place)
        with pytest.raises(KeyboardInterrupt):
            fit(
                Net(),
                stop.loss,
                N,
                options(checkpoint_seconds=every),
                tmp_path,
                progress=stop.progress,
            )
    net = Net()
    log = fit(net, loss, N, options(), tmp_path)
    assert same(weights(net), whole[0])
    assert without_time(log) == without_time(whole[1])


def test_ctrl_c_between_steps_loses_nothing(tmp_path):
    stop = StopAt(7, None, "progress")
    with pytest.raises(KeyboardInterrupt):
        fit(Net(), loss, N, options(), tmp_path, progress=stop.progress)
    steps = []
    fit(Net(), lambda m, r, g, s: (steps.append(s), loss(m, r, g, s))[1], N, options(), tmp_path)
    assert steps == list(range(8, STEPS))


def test_interrupted_twice_and_while_saving(tmp_path, whole):
    real = loop.save_file
    calls = []

    def save(*args, **kwargs):
        calls.append(1)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return real(*args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "save_file", save)
        with pytest.raises(KeyboardInterrupt):
            fit(Net(), loss, N, options(checkpoint_seconds=0.0), tmp_path)
    with pytest.raises(KeyboardInterrupt):
        fit(Net(), StopAt(9, None, "loss").loss, N, options(), tmp_path)
    net = Net()
    fit(net, loss, N, options(), tmp_path)
    assert same(weights(net), whole[0])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["checkpoint.safetensors", "log.jsonl"]


def test_finished_run_is_only_read(tmp_path, whole):
    for _ in range(2):
        net = Net()
        log = fit(net, loss, N, options(), tmp_path)
        assert same(weights(net), whole[0])
        assert without_time(log) == without_time(whole[1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "save_file", None)  # would fail if it wrote
        fit(Net(), StopAt(0, None, "loss").loss, N, options(), tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 6},
        {"lr": 2e-2},
        {"steps": STEPS + 3},
        {"batch": 5},
        {"ema": 0.5},
        {"betas": (0.9, 0.95)},
        {"decay": "constant"},
    ],
)
def test_changed_options_start_anew(tmp_path, whole, change):
    fresh, again = Net(), Net()
    fit(fresh, loss, N, options(**change), tmp_path / "fresh")
    fit(Net(), loss, N, options(), tmp_path / "again")
    fit(again, loss, N, options(**change), tmp_path / "again")
    assert same(weights(again), weights(fresh))
    assert not same(weights(again), whole[0])


def test_changed_key_rows_or_shapes_start_anew_but_checkpoint_interval_does_not(tmp_path):
    fit(Net(), loss, N, options(), tmp_path, key="a")

    def steps_taken(net=None, n=N, **kwargs):
        steps = []
        fit(
            net or Net(),
            lambda m, r, g, s: (steps.append(s), loss(m, r, g, s))[1],
            n,
            kwargs.pop("options", options()),
            tmp_path,
            **kwargs,
        )
        return len(steps)

    assert steps_taken(key="a") == 0
    assert steps_taken(key="a", options=options(checkpoint_seconds=1.0)) == 0
    assert steps_taken(key="b") == STEPS
    assert steps_taken(key="b", n=N - 1) == STEPS
    wider = Net()
    wider.a, wider.b = nn.Linear(5, 8), nn.Linear(8, 1)
    assert steps_taken(wider, key="b") == STEPS


def test_average_is_the_written_formula(tmp_path):
    seen = []

    def watched(module, rows, generator, step):
        if step:
            seen.append(module.b.weight.detach().clone())
        return loss(module, rows, generator, step)

    raw, averaged = Net(), Net()
    first = averaged.b.weight.detach().clone()
    fit(raw, watched, N, options(ema=None), tmp_path / "raw")
    fit(averaged, loss, N, options(ema=0.6), tmp_path / "averaged")
    expect = first.double()
    for k, w in enumerate([*seen, raw.b.weight.detach()]):
        d = min(0.6, (1 + k) / (10 + k))
        expect = d * expect + (1 - d) * w.double()
    assert torch.allclose(averaged.b.weight.double(), expect, atol=1e-6)
    assert not torch.allclose(averaged.b.weight, raw.b.weight, atol=1e-3)


def test_loss_that_is_not_finite_is_told_and_not_kept(tmp_path):
    bad = lambda m, r, g, s: (loss(m, r, g, s)[0] * (math.nan if s == 4 else 1), {})  # noqa: E731
    with pytest.raises(PalpateError, match="nan at step 4"):
        fit(Net(), bad, N, options(checkpoint_seconds=0.0), tmp_path)
    with safe_open(tmp_path / "checkpoint.safetensors", framework="pt") as file:
        assert file.metadata()["step"] == "4"
        assert all(torch.isfinite(file.get_tensor(k)).all() for k in file.keys())  # noqa: SIM118


@pytest.mark.parametrize("clip", [None, 1.0])
def test_finite_loss_with_infinite_gradient_is_reported(tmp_path, clip):
    def bad(module, rows, generator, step):
        value, logs = loss(module, rows, generator, step)
        return value + (torch.sqrt(module.a.weight[0, 0] * 0) if step == 2 else 0), logs

    with pytest.raises(PalpateError, match="gradient"):
        fit(Net(), bad, N, options(clip=clip), tmp_path)


def test_no_clip_leaves_gradients_alone(tmp_path):
    a, b = Net(), Net()
    fit(a, loss, N, options(clip=None), tmp_path / "a")
    fit(b, loss, N, options(clip=1e9), tmp_path / "b")
    assert same(weights(a), weights(b))


def test_no_rows_no_parameters_bad_options(tmp_path):
    with pytest.raises(PalpateError, match="at least one sample"):
        fit(Net(), loss, 0, options(), tmp_path)
    with pytest.raises(PalpateError, match="parameters"):
        fit(Net().requires_grad_(False), loss, N, options(), tmp_path)
    for change in (
        {"batch": 0},
        {"steps": -1},
        {"lr": 0.0},
        {"lr": math.inf},
        {"decay": "linear"},
        {"ema": 1.0},
        {"clip": 0.0},
        {"warmup": -1},
    ):
        with pytest.raises(PalpateError, match=f"`{next(iter(change))}` must"):
            options(**change)


def test_broken_checkpoint_is_reported(tmp_path):
    fit(Net(), loss, N, options(), tmp_path)
    file = tmp_path / "checkpoint.safetensors"
    file.write_bytes(file.read_bytes()[:50])
    with pytest.raises(PalpateError, match=r"checkpoint\.safetensors"):
        fit(Net(), loss, N, options(), tmp_path)


def test_no_steps_leaves_the_model(tmp_path):
    net = Net()
    assert fit(net, loss, N, options(steps=0), tmp_path) == []
    assert same(weights(net), weights(Net()))


def test_rows_are_whole_shuffled_epochs():
    rows = np.concatenate([rows_at(k, 4, N, 0) for k in range(2 * N)])
    epochs = rows[: 8 * N].reshape(8, N)
    assert (np.sort(epochs, axis=1) == np.arange(N)).all()
    assert len({tuple(e) for e in epochs}) == 8
    assert sorted(rows_at(0, 3 * N, N, 0)) == sorted([*range(N)] * 3)


def test_learning_rate_by_hand():
    o = options(steps=13, warmup=3, lr=6.0)
    assert [learning_rate(k, o) for k in range(4)] == [2.0, 4.0, 6.0, 6.0]
    assert learning_rate(8, o) == pytest.approx(3.0)
    assert learning_rate(13, o) == pytest.approx(0.0)
    assert learning_rate(12, options(steps=13, warmup=3, lr=6.0, decay="constant")) == 6.0


def test_log_file_is_the_log(tmp_path):
    log = fit(Net(), loss, N, options(), tmp_path)
    assert [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()] == log
    assert [line["step"] for line in log] == [0, 10, STEPS - 1]
    assert all(line["step_again"] == line["step"] for line in log)


KILLED = """
import os, signal, sys
from pathlib import Path
from test_training_loop import N, Net, loss, options
from palpate.training.loop import fit

def until(module, rows, generator, step):
    if step == int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGKILL)
    return loss(module, rows, generator, step)

fit(Net(), until, N, options(checkpoint_seconds=0), Path(sys.argv[1]))
"""


@pytest.mark.slow
def test_a_run_that_gets_sigkill_in_mid_training_ends_as_one_that_did_not(tmp_path):
    whole = Net()
    fit(whole, loss, N, options(checkpoint_seconds=0), tmp_path / "whole")
    for step in (6, 11):
        command = [sys.executable, "-c", KILLED, str(tmp_path / "killed"), str(step)]
        done = subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False
        )
        assert done.returncode == -signal.SIGKILL, done.stderr
        with safe_open(tmp_path / "killed" / "checkpoint.safetensors", framework="pt") as file:
            assert file.metadata()["step"] == str(step)
    again = Net()
    fit(again, loss, N, options(checkpoint_seconds=0), tmp_path / "killed")
    assert all(
        torch.equal(a, b)
        for a, b in zip(whole.state_dict().values(), again.state_dict().values(), strict=True)
    )
