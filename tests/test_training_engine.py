"""The training loop: interrupted and resumed, it takes the same steps."""

import json
import math
import os
import shutil
import signal
import time
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors import safe_open
from tensorboardX.proto.event_pb2 import Event
from torch import nn

from forge.damage import flip
from forge.errors import fails
from palpate.core import PalpateError, PalpateWarning, quiet
from palpate.training import engine
from palpate.training.engine import Losses, Task
from palpate.training.options import Compute, LoopOptions, RowOrder, learning_rate
from palpate.training.processes import barrier, first_alone, merged, place
from palpate.training.run import work_folder

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


def load(step):
    noise = 0.1 * step.randn(5)
    return {"rows": torch.from_numpy(step.rows), "noise": noise, "step": torch.tensor(step.number)}


def loss(module, batch):
    module.seen += module.training
    y = module.b(torch.tanh(module.a(module.data[batch["rows"]] + batch["noise"])))
    error = (y - module.target[batch["rows"]]).square()
    return Losses(error.mean(), {"step_again": batch["step"]}, error.detach())


NEVER = Compute(checkpoint_minutes=1e9)
ALWAYS = Compute(checkpoint_minutes=0)


def fit(module, loss, n, options, folder, compute=NEVER, key="", progress=quiet, **task):
    task = Task("training", n, load, loss, key, **task)
    return engine.fit(module, task, options, folder, compute=compute, progress=progress)


def options(**change):
    return LoopOptions(
        **{"steps": STEPS, "batch": 4, "lr": 1e-2, "warmup": 3, "ema": 0.9, "seed": 5, **change}
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
            real_lerp = torch._foreach_lerp_

            def lerp(averages, weights, share):
                self.count += 1
                if self.count == step:  # the average is half done
                    real_lerp(averages[:2], weights[:2], share)
                    raise KeyboardInterrupt
                return real_lerp(averages, weights, share)

            monkeypatch.setattr(torch, "_foreach_lerp_", lerp)

    def _in_loss(self, module, batch):
        if int(batch["step"]) == self.step:
            raise KeyboardInterrupt
        return loss(module, batch)

    def _in_progress(self, what, done, total, remark=""):
        if done == self.step + 1:
            raise KeyboardInterrupt


@pytest.mark.parametrize("place", ["loss", "update", "average", "progress"])
@pytest.mark.parametrize("step", [0, 1, 7, STEPS - 1])
@pytest.mark.parametrize("every", [NEVER, ALWAYS])  # a checkpoint never, or after each step
def test_interrupted_and_resumed_equals_uninterrupted(tmp_path, whole, place, step, every):
    with pytest.MonkeyPatch.context() as patch:
        stop = StopAt(step, patch, place)
        with pytest.raises(KeyboardInterrupt):
            fit(Net(), stop.loss, N, options(), tmp_path, every, progress=stop.progress)
    net = Net()
    log = fit(net, loss, N, options(), tmp_path)
    assert same(weights(net), whole[0])
    assert without_time(log) == without_time(whole[1])


def counting(steps):
    def counted(module, batch):
        steps.append(int(batch["step"]))
        return loss(module, batch)

    return counted


def test_ctrl_c_between_steps_loses_nothing(tmp_path):
    stop = StopAt(7, None, "progress")
    with pytest.raises(KeyboardInterrupt):
        fit(Net(), loss, N, options(), tmp_path, progress=stop.progress)
    steps = []
    fit(Net(), counting(steps), N, options(), tmp_path)
    assert steps == list(range(8, STEPS))


def test_interrupted_twice_and_while_saving(tmp_path, whole):
    real = engine.save_file
    calls = []

    def save(*args, **kwargs):
        calls.append(1)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return real(*args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "save_file", save)
        with pytest.raises(KeyboardInterrupt):
            fit(Net(), loss, N, options(), tmp_path, ALWAYS)
    with pytest.raises(KeyboardInterrupt):
        fit(Net(), StopAt(9, None, "loss").loss, N, options(), tmp_path)
    net = Net()
    fit(net, loss, N, options(), tmp_path)
    assert same(weights(net), whole[0])
    checkpoint = "checkpoint.safetensors"
    files = [checkpoint, f"{checkpoint}.sha256", "log.jsonl"]
    assert sorted(p.name for p in tmp_path.iterdir()) == files


def test_finished_run_is_only_read(tmp_path, whole):
    for _ in range(2):
        net = Net()
        log = fit(net, loss, N, options(), tmp_path)
        assert same(weights(net), whole[0])
        assert without_time(log) == without_time(whole[1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "save_file", None)  # would fail if it wrote
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
        fit(net or Net(), counting(steps), n, options(), tmp_path, **kwargs)
        return len(steps)

    assert steps_taken(key="a") == 0
    assert steps_taken(key="a", compute=Compute(checkpoint_minutes=1.0)) == 0
    assert steps_taken(key="b") == STEPS
    assert steps_taken(key="b", n=N - 1) == STEPS
    wider = Net()
    wider.a, wider.b = nn.Linear(5, 8), nn.Linear(8, 1)
    assert steps_taken(wider, key="b") == STEPS


def test_average_is_the_written_formula(tmp_path):
    seen = []

    def watched(module, batch):
        if batch["step"]:
            seen.append(module.b.weight.detach().clone())
        return loss(module, batch)

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


def test_a_loss_that_is_not_finite_names_its_rows_and_is_not_kept(tmp_path):
    broken, step = Net(), 4
    row = RowOrder(N, 4, 5)(step)[1]
    broken.data[row] = math.nan
    names = [f"sample {k}" for k in range(N)]
    with pytest.raises(PalpateError, match=f"nan at step {step}, with sample {row}. Look"):
        fit(broken, loss, N, options(), tmp_path, ALWAYS, names=names)
    with safe_open(tmp_path / "checkpoint.safetensors", framework="pt") as file:
        assert file.metadata()["step"] == str(step)
        kept = (file.get_tensor(name) for name in ("model.a.weight", "ema.b.bias"))
        assert all(torch.isfinite(value).all() for value in kept)


def test_only_a_checkpoint_that_there_is_is_said_to_be_kept(tmp_path):
    def message(compute, last):
        caught = fails("", fit, Net(), overflowing({last}), N, options(), tmp_path, compute)
        return str(caught)

    assert message(NEVER, 3).endswith("or lower the learning rate.")
    assert message(ALWAYS, 3).endswith("the last checkpoint is kept.")
    assert message(NEVER, 5).endswith("the last checkpoint is kept.")  # of the run before


def test_of_several_processes_each_names_the_bad_rows_of_the_whole_batch(
    tmp_path, on_two_processes
):
    row = int(RowOrder(N, 4, 5)(4)[3])  # of the second process

    def message():
        broken = Net()
        broken.data[row] = math.nan
        caught = fails("must be finite", fit, broken, loss, N, options(), tmp_path)
        return [caught.got, caught.shared]

    assert on_two_processes(message) == [[f"nan at step 4, with row {row}", True]] * 2


def test_a_batch_that_processes_cannot_share_is_rejected(tmp_path, on_two_processes):
    def message():
        with pytest.raises(PalpateError, match="multiple of the 2 processes") as caught:
            fit(Net(), loss, 7, options(batch=8), tmp_path)
        return [caught.value.got, caught.value.shared]

    assert on_two_processes(message) == [["7, all training samples", True]] * 2


def test_processes_without_an_output_share_a_folder_until_all_are_done(on_two_processes):
    def folder():
        with work_folder(None) as work:
            (work / f"{place()[0]}").touch()
            barrier()
            return [str(work), len(list(work.iterdir()))]

    one, two = on_two_processes(folder)
    assert one == two
    assert one[1] == 2


@pytest.mark.parametrize("wait", [barrier, lambda: merged({})])
def test_who_waits_for_a_process_that_has_ended_says_so(on_two_processes, wait):
    def message():
        if place()[0]:
            return None  # and ends
        caught = fails("All processes must stay alive", wait)
        return caught.got

    got, _ = on_two_processes(message)
    assert got.startswith("one has ended")


def test_the_first_process_goes_alone_and_before_the_others(tmp_path, on_two_processes):
    def files():
        with first_alone():
            before = sorted(p.name for p in tmp_path.glob("mark-*"))
            time.sleep(0.2)
            (tmp_path / f"mark-{place()[0]}").touch()
        return before

    assert on_two_processes(files) == [[], ["mark-0"]]


@pytest.mark.parametrize("clip", [None, 1.0])
def test_finite_loss_with_infinite_gradient_is_reported(tmp_path, clip):
    fails("gradient", fit, Net(), overflowing({2}), N, options(clip_norm=clip), tmp_path)


def test_no_clip_leaves_gradients_alone(tmp_path):
    a, b = Net(), Net()
    fit(a, loss, N, options(clip_norm=None), tmp_path / "a")
    fit(b, loss, N, options(clip_norm=1e9), tmp_path / "b")
    assert same(weights(a), weights(b))


def test_no_rows_no_parameters_no_steps_bad_options(tmp_path):
    net = Net()
    assert fit(net, loss, N, options(steps=0), tmp_path) == []
    assert same(weights(net), weights(Net()))
    fails("at least one sample", fit, Net(), loss, 0, options(), tmp_path)
    assert fit(Net(), loss, 1, options(), tmp_path / "one")[-1]["step"] == STEPS - 1
    fails("parameters", fit, Net().requires_grad_(False), loss, N, options(), tmp_path)
    for change in (
        {"batch": 0},
        {"steps": -1},
        {"lr": 0.0},
        {"lr": math.inf},
        {"decay": "linear"},
        {"ema": 1.0},
        {"clip_norm": 0.0},
        {"warmup": -1},
        {"keep": "first"},
        {"patience": 1, "evaluations": 0},
    ):
        fails(f"`{next(iter(change))}` must", options, **change)


@pytest.mark.parametrize("name", ["checkpoint", "best"])
def test_a_damaged_checkpoint_is_refused_with_the_way_back(tmp_path, name):
    held_out = {"held_out": (4, load)}
    fit(Net(), loss, N, options(keep="best"), tmp_path, **held_out)
    (file,) = tmp_path.glob(f"{name}*.safetensors")
    flip(file)
    words = f"{file} must be whole. Got damaged: its digest is another. Remove {tmp_path} to start"
    fails(words, fit, Net(), loss, N, options(keep="best"), tmp_path, **held_out)
    shutil.rmtree(tmp_path)
    fit(Net(), loss, N, options(keep="best"), tmp_path, **held_out)


@pytest.mark.parametrize("batch", [1, 4, 11, 12, 17, 22, 23])
def test_rows_are_whole_shuffled_epochs_without_a_row_twice_in_a_batch(batch):
    order = RowOrder(N, batch, 0)
    steps = [order(k) for k in range(2 * N)]
    assert all(len(set(rows)) == batch for rows in steps)
    epochs = np.concatenate(steps)[: 2 * batch * N].reshape(2 * batch, N)
    assert (np.sort(epochs, axis=1) == np.arange(N)).all()
    assert len({tuple(e) for e in epochs}) == 2 * batch
    for k in (2 * N - 1, 0, N):  # started anywhere, also before
        assert (RowOrder(N, batch, 0)(k) == steps[k]).all()
        assert (order(k) == steps[k]).all()


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


def test_runs_killed_at_ten_random_steps_end_as_one_that_was_not(tmp_path, whole):
    """Each time a forked process trains in the same folder until SIGKILL ends it."""
    rng = np.random.default_rng(0)
    for step in np.sort(rng.choice(STEPS, 10, replace=False)):

        def until(module, batch, last=step):
            if batch["step"] == last:
                os.kill(os.getpid(), signal.SIGKILL)
            return loss(module, batch)

        if (child := os.fork()) == 0:
            fit(Net(), until, N, options(), tmp_path, ALWAYS)
            os._exit(1)  # it was not killed
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    again = Net()
    log = fit(again, loss, N, options(), tmp_path, ALWAYS)
    assert same(weights(again), whole[0])
    assert without_time(log) == without_time(whole[1])


def held_out(**change):
    steps = []

    def counted(module, batch):
        steps.append(module.training)
        return loss(module, batch)

    net = Net()
    return net, steps, counted, options(evaluations=7, **change)


def test_held_out_loss_is_logged_and_its_best_weights_are_kept(tmp_path):
    last, steps, counted, how = held_out(keep="last")
    log = fit(last, counted, N, how, tmp_path / "last", held_out=(9, load))
    losses = {line["step"]: line["held_out"] for line in log if "held_out" in line}
    assert len(losses) == 7
    assert max(losses) == STEPS - 1
    assert steps.count(False) == 7 * 2  # two whole batches of nine rows
    plain = Net()
    fit(plain, loss, N, options(evaluations=7), tmp_path / "plain")
    assert same(weights(last), weights(plain))
    best, _, counted, how = held_out(keep="best", lr=0.5)
    log = fit(best, counted, N, how, tmp_path / "best", held_out=(9, load))
    losses = [line["held_out"] for line in log if "held_out" in line]
    assert losses.index(min(losses)) < 6  # at this rate it became worse again
    again, steps, counted, how = held_out(keep="best", lr=0.5, patience=1)
    log = fit(again, counted, N, how, tmp_path / "stopped", held_out=(9, load))
    stopped = [line["held_out"] for line in log if "held_out" in line]
    assert stopped == losses[: len(stopped)]
    assert stopped[-1] >= stopped[-2] == min(stopped)
    count = len(steps)
    fit(Net(), counted, N, how, tmp_path / "stopped", held_out=(9, load))
    assert len(steps) == count  # a run that has stopped stays so


def test_the_best_weights_are_those_of_the_run_that_goes_on(tmp_path):
    def best(folder, progress=quiet, loss=loss, **change):
        net, how = Net(), options(evaluations=7, keep="best", lr=0.5, **change)
        fit(net, loss, N, how, folder, held_out=(9, load), progress=progress)
        return weights(net)

    whole, stop = best(tmp_path / "whole"), StopAt(11, None, "progress")
    with pytest.raises(KeyboardInterrupt):
        best(tmp_path, stop.progress)
    with pytest.raises(PalpateError, match="gradient"):  # another run, which leaves no checkpoint
        best(tmp_path, loss=overflowing({9}), seed=6)
    assert same(best(tmp_path), whole)


@pytest.mark.parametrize("rows", [1, 3, 9])
def test_held_out_loss_is_that_of_all_rows_on_any_number_of_processes(
    tmp_path, on_two_processes, rows
):
    def losses(folder="two"):
        how, task = options(evaluations=3, lr=0.1), {"held_out": (rows, load)}
        log = fit(Net(), loss, N, how, tmp_path / folder, **task)
        return [line["held_out"] for line in log if "held_out" in line]

    one, two = losses("one"), on_two_processes(losses)
    assert two[0] == two[1] == pytest.approx(one, rel=1e-5)
    assert len(one) == 3


def test_held_out_batches_are_shuffled_rows_of_nearly_equal_number(tmp_path):
    batches = []

    def watched(step):
        batches.append(step.rows.tolist())
        return load(step)

    fit(Net(), loss, N, options(evaluations=2), tmp_path, held_out=(11, watched))
    assert [len(rows) for rows in batches] == [6, 5] * 2
    assert batches[:2] == batches[2:]
    assert sorted(batches[0] + batches[1]) == list(range(11)) != batches[0] + batches[1]


def test_a_held_out_loss_that_is_not_finite_is_reported(tmp_path):
    def breaks(module, batch):
        return loss(module, batch)._replace(total=module.b.weight.sum() * math.nan)

    def only_held_out(module, batch):
        return (loss if module.training else breaks)(module, batch)

    words = rf"held-out loss of training must be finite. Got nan after step {STEPS - 1}\."
    with pytest.raises(PalpateError, match=words):
        fit(Net(), only_held_out, N, options(evaluations=1), tmp_path, held_out=(9, load))


def test_the_loss_that_is_shown_is_smoothed_and_seconds_are_those_of_a_step(tmp_path, monkeypatch):
    steps, remarks = [], []

    def constant(module, batch):
        steps.append(1)
        return loss(module, batch)._replace(total=0 * module.b.weight.sum() + 2)

    clock = SimpleNamespace(monotonic=lambda: 3.0 * len(steps))  # of three seconds a step
    monkeypatch.setattr(engine, "time", clock)
    report = lambda task, done, total, remark="": remarks.append(remark)
    log = fit(Net(), constant, N, options(), tmp_path, progress=report)
    assert [line["seconds"] for line in log] == [3.0] * len(log)
    assert {*remarks} >= {"loss 2.0000"}
    assert all(remark in ("", "loss 2.0000") for remark in remarks)
    how = options(evaluations=2)
    fit(Net(), constant, N, how, tmp_path / "held", progress=report, held_out=(9, load))
    assert remarks[-1] == "loss 2.0000, held out 2.0000"


def test_a_full_disk_ends_in_one_line_and_keeps_the_last_checkpoint(tmp_path, whole):
    calls = []
    real = engine.save_file

    def full(*args, **kwargs):
        calls.append(1)
        if len(calls) == 4:
            raise engine.SafetensorError("No space left on device")
        real(*args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "save_file", full)
        with pytest.raises(
            PalpateError, match=r"checkpoint.safetensors must be writable.*No space"
        ):
            fit(Net(), loss, N, options(), tmp_path, ALWAYS)
    net = Net()
    fit(net, loss, N, options(), tmp_path)
    assert same(weights(net), whole[0])
    stop = StopAt(7, None, "progress")  # Ctrl-C, whose checkpoint is the fourth
    calls[:] = [1] * 3
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "save_file", full)
        with pytest.raises(PalpateError, match="must be writable"):
            fit(Net(), loss, N, options(), tmp_path / "stopped", progress=stop.progress)


@pytest.mark.parametrize(("precision", "lines"), [("bf16", 3), ("fp16", 2)])
def test_half_precision_learns(tmp_path, whole, precision, lines):
    compute = Compute(precision=precision, checkpoint_minutes=1e9)
    log = fit(Net(), loss, N, options(), tmp_path, compute)
    for row, plain in list(zip(log, whole[1], strict=True))[:lines]:
        assert row["loss"] == pytest.approx(plain["loss"], rel=0.01)


@pytest.mark.parametrize("has", [True, False])
def test_a_processor_without_bf16_computes_in_float32_and_says_so(tmp_path, whole, has):
    known = {"architecture": "x86_64", "avx512_bf16": has, "amx_bf16": False}
    seen = []

    def watched(module, batch):
        seen.append(torch.is_autocast_enabled("cpu"))
        return loss(module, batch)

    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PalpateWarning)
        patch.setattr(torch.cpu, "get_capabilities", lambda: known)
        fit(Net(), watched, N, options(), tmp_path, Compute(precision="bf16"))
    assert set(seen) == {has}
    assert len([w for w in caught if "no bf16" in str(w.message)]) == (not has)


def overflowing(steps):
    """The loss, with infinite gradients in these steps."""

    def changed(module, batch):
        losses = loss(module, batch)
        harm = torch.sqrt(module.a.weight[0, 0] * 0) if int(batch["step"]) in steps else 0
        return losses._replace(total=losses.total + harm)

    return changed


def test_a_skipped_step_of_16_bits_is_resumed_exactly(tmp_path):
    compute = Compute(precision="fp16", checkpoint_minutes=0)
    whole, again, bad = Net(), Net(), overflowing({2, 3})
    fit(whole, bad, N, options(), tmp_path / "whole", compute)
    stop = StopAt(6, None, "progress")
    with pytest.raises(KeyboardInterrupt):
        fit(Net(), bad, N, options(), tmp_path / "again", compute, progress=stop.progress)
    fit(again, bad, N, options(), tmp_path / "again", compute)
    assert same(weights(again), weights(whole))


def test_gradients_of_16_bits_that_overflow_at_every_scale_are_reported(tmp_path):
    how = options(steps=40)
    with pytest.raises(PalpateError, match=r"gradient of training must be finite.*at step 1[5-8]"):
        fit(Net(), overflowing(range(40)), N, how, tmp_path, Compute(precision="fp16"))


@pytest.mark.parametrize("tf32", [True, False])
def test_tf32_is_set_for_products_and_convolutions_and_restored(tmp_path, tf32):
    backends, seen = (torch.backends.cuda.matmul, torch.backends.cudnn), []

    def watched(module, batch):
        seen.append([backend.allow_tf32 for backend in backends])
        return loss(module, batch)

    before = [backend.allow_tf32 for backend in backends]
    fit(Net(), watched, N, options(steps=1), tmp_path, Compute(tf32=tf32))
    assert seen == [[tf32, tf32]]
    assert [backend.allow_tf32 for backend in backends] == before


def a_sheet(module):
    assert not module.training
    value = float(module.b.weight.detach().abs().mean())
    return np.full((4, 6, 3), round(255 * min(1, value)), np.uint8)


def test_samples_are_drawn_with_each_checkpoint_and_change_nothing(tmp_path, whole):
    net = Net()
    fit(net, loss, N, options(), tmp_path, ALWAYS, samples=a_sheet)
    assert same(weights(net), whole[0])
    drawn = sorted((tmp_path / "samples").iterdir())
    assert [p.name for p in drawn] == [f"{k:07}.png" for k in range(1, STEPS + 1)]
    shown = np.asarray(Image.open(drawn[-1]))
    assert (shown == a_sheet(net)).all()  # the averaged weights, which are the result
    fit(Net(), loss, N, options(), tmp_path / "once", samples=a_sheet)
    assert [p.name for p in (tmp_path / "once" / "samples").iterdir()] == [drawn[-1].name]


def events(file):
    """The records of a TensorBoard file: length, checksum, event, checksum."""
    data = file.read_bytes()
    while data:
        n = int.from_bytes(data[:8], "little")
        yield Event.FromString(data[12 : 12 + n])
        data = data[16 + n :]


def test_tensorboard_has_the_log_and_the_samples(tmp_path):
    compute = Compute(trackers=("tensorboard",))
    log = fit(Net(), loss, N, options(), tmp_path, compute, samples=a_sheet)
    (file,) = (tmp_path / "tensorboard").glob("*tfevents*")
    values, images = {}, []
    for event in events(file):
        for value in event.summary.value:
            if value.HasField("image"):
                images.append((event.step, value.image.height, value.image.width))
            else:
                values[event.step, value.tag] = value.simple_value
    assert images == [(STEPS, 4, 6)]
    for line in log:
        for name in ("loss", "lr"):
            assert values[line["step"], name] == pytest.approx(line[name], rel=1e-6)


WANDB = """
import json
class Run:
    def __init__(self):
        self.lines = []
    def update(self, values, **_):
        self.lines.append(values)
    def log(self, values, step=None, **_):
        self.lines.append([step, {k: v for k, v in values.items() if k != "samples"}])
    def finish(self):
        json.dump(self.lines, open("wandb.json", "w"))
def init(project, **_):
    global config
    config = Run()
    return config
Image = list
"""


def test_wandb_has_the_settings_and_the_log(tmp_path, monkeypatch):
    (tmp_path / "wandb.py").write_text(WANDB)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    log = fit(Net(), loss, N, options(), tmp_path / "run", Compute(trackers=("wandb",)))
    settings, *lines = json.loads((tmp_path / "wandb.json").read_text())
    assert (settings["lr"], settings["batch"]) == (options().lr, options().batch)
    assert [step for step, _ in lines] == [line["step"] for line in log]
    assert lines[-1][1]["loss"] == log[-1]["loss"]


def test_blocks_that_cannot_be_computed_twice_are_named(tmp_path):
    compute = Compute(gradient_checkpointing=True)
    fails("blocks can be computed twice", fit, Net(), loss, N, options(), tmp_path, compute)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "apart"),
    [
        pytest.param({"compile": True}, 1e-5, marks=pytest.mark.nightly),
        ({"channels_last": True}, 1e-6),
        ({"tf32": False}, 0),
    ],
)
def test_how_it_is_run_changes_rounding_alone(tmp_path, whole, change, apart):
    log = fit(Net(), loss, N, options(), tmp_path, Compute(**change))
    for row, plain in zip(log, whole[1], strict=True):
        assert row["loss"] == pytest.approx(plain["loss"], abs=apart)
