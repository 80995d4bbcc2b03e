"""The streaming metrics as torchmetrics.Metric: processes, collections, forward, state dicts."""

import copy
import pickle
import warnings

import numpy as np
import pytest

torch = pytest.importorskip("torch")
torchmetrics = pytest.importorskip("torchmetrics")

from palpate.core import PalpateError  # noqa: E402
from palpate.metrics import four_scores, streaming, tmmd, torch_metric  # noqa: E402
from test_metrics_streaming import both, close, feed, sets  # noqa: E402

NAMES = ("TMMD", "ITMMD", "CITMMD", "DTMMD")


def made(name, of=torch_metric, **options):
    return getattr(of, name)(**options)


def plain_score(name, g, r, **options):
    return both(made(name, streaming), g, r, **options).compute()


def same(tensor, score):
    return tensor.item() == pytest.approx(score.value, abs=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_a_true_metric_with_the_same_score(name):
    g, r = sets()
    metric = both(made(name), g, r)
    want = plain_score(name, g, r)
    assert isinstance(metric, torchmetrics.Metric)
    assert (metric.higher_is_better, metric.is_differentiable, metric.full_state_update) == (
        False if name == "TMMD" else None,
        False,
        False,
    )
    value = metric.compute()
    assert (value.dtype, value.ndim) == (torch.float64, 0)
    assert same(value, want)
    assert close(metric.score().to_json(), want.to_json())
    before = metric.update_count
    metric.update(np.zeros((0, 6)))
    assert metric.update_count == before + 1
    assert same(metric.compute(), want)


def rank(number, where, out):
    """One of two processes; the second gets a quarter of the rows, and no real ones."""
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{where}", rank=number, world_size=2
    )
    g, r = sets()
    cut = 3 * len(g.ids) // 4
    found = {}
    for name in NAMES:
        metric = made(name)
        feed(
            metric,
            g,
            order=np.arange(cut) if number == 0 else np.arange(cut, len(g.ids)),
            step=5 + number,
        )
        if number == 0:
            feed(metric, r, real=True)
        synced = metric.compute().item(), metric.score().to_json()
        rows = (
            metric.plain.score_of(metric._read(metric.records)).n if number == 0 else None
        )  # unsynchronized again
        metric.update(g.features[:0])
        found[name] = (*synced, rows, metric.compute().item())
    alone = made("ITMMD")  # one process has seen nothing
    if number == 0:
        feed(alone, g)
    collection = torchmetrics.MetricCollection([made(name) for name in NAMES])
    part = np.arange(number, len(g.ids), 2)
    both(collection, g, r, order=part, step=8)
    together = {k: v.item() for k, v in collection.compute().items()}
    again = both(collection, g, r, order=part[:0]).compute()
    found["alone"], found["collection"], found["again"] = (
        alone.compute().item(),
        together,
        {k: v.item() for k, v in again.items()},
    )
    with open(f"{out}.{number}", "wb") as file:
        pickle.dump(found, file)
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_two_gloo_processes_give_what_one_gives(tmp_path):
    torch.multiprocessing.spawn(rank, (str(tmp_path / "meet"), str(tmp_path / "out")), nprocs=2)
    found = [pickle.loads((tmp_path / f"out.{k}").read_bytes()) for k in range(2)]
    g, r = sets()
    for name in NAMES:
        want = plain_score(name, g, r)
        for one in found:
            value, score, _, later = one[name]
            assert value == pytest.approx(want.value, abs=1e-9)
            assert later == value
            assert close(score, want.to_json())
            assert one["collection"][name] == pytest.approx(want.value, abs=1e-9)
            assert one["again"] == one["collection"]
        assert found[0][name][2] == 3 * len(g.ids) // 4
    alone = feed(made("ITMMD", streaming), g).compute()
    assert [one["alone"] for one in found] == pytest.approx([alone.value] * 2, abs=1e-9)


def other_settings(number, where, out):
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{where}", rank=number, world_size=2
    )
    metric = feed(torch_metric.ITMMD(encoder=str(number)), sets()[0])
    try:
        metric.compute()
        said = ""
    except PalpateError as error:
        said = str(error)
    with open(f"{out}.{number}", "w") as file:
        file.write(said)
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_processes_of_different_settings_are_refused(tmp_path):
    torch.multiprocessing.spawn(
        other_settings, (str(tmp_path / "meet"), str(tmp_path / "out")), nprocs=2
    )
    assert any("same settings" in (tmp_path / f"out.{k}").read_text() for k in range(2))


def test_collections_share_one_list_of_features():
    g, r = sets()
    collection = torchmetrics.MetricCollection([made(name) for name in NAMES])
    both(collection, g, r)
    assert [sorted(group) for group in collection.compute_groups.values()] == [sorted(NAMES)]
    lists = [m.records for m in collection.values(copy_state=False)]
    assert all(x is lists[0] for x in lists)
    for name, value in collection.compute().items():
        assert same(value, plain_score(name, g, r))
    collection.reset()
    both(collection, r, g)
    for name, value in collection.compute().items():
        assert same(value, plain_score(name, r, g))


def test_a_collection_may_be_called_and_may_keep_real_samples():
    g, r = sets()
    collection = torchmetrics.MetricCollection(
        [made(name, reset_real_features=False) for name in NAMES]
    )
    feed(collection, r, real=True)
    for _ in range(2):
        for k in range(0, len(g.ids), 30):
            at = slice(k, k + 30)
            values = collection(
                g.features[at], ids=g.ids[at], labels=g.labels[at], groups=g.groups[at]
            )
            assert set(values) == set(NAMES)
        for name, value in collection.compute().items():
            assert same(value, plain_score(name, g, r))
        collection.reset()


def test_metrics_of_different_settings_are_not_one_group():
    g, r = sets()
    kept = torchmetrics.MetricCollection(
        {"a": torch_metric.TMMD(reset_real_features=False), "b": torch_metric.ITMMD()}
    )
    both(kept, g, r)
    kept.reset()
    feed(kept, g)
    assert same(kept["a"].compute(), tmmd(g, r))


def test_forward_gives_the_batch_and_adds_it_once():
    name = "TMMD"
    g, r = sets()
    metric = made(name, reset_real_features=False)
    assert metric(r.features, real=True, groups=r.groups, ids=r.ids).isnan()
    half = np.arange(40)
    columns = lambda at: {"ids": [g.ids[k] for k in at], "groups": [g.groups[k] for k in at]}
    first = metric(g.features[half], **columns(half))
    want = both(made(name, streaming), g, r, order=half).compute()
    alone = made(name, streaming)
    feed(feed(alone, g, order=half), r, real=True)
    assert same(first, alone.compute())
    assert not same(first, want)  # fewer real ones
    rest = np.arange(40, len(g.ids))
    metric(g.features[rest], **columns(rest))
    assert same(metric.compute(), plain_score(name, g, r))
    metric.reset()
    assert metric(r.features[:0]).isnan()
    metric(features=g.features, **columns(range(len(g.ids))))
    assert same(metric.compute(), plain_score(name, g, r))


@pytest.mark.parametrize("name", NAMES)
def test_copies_pickles_and_merges(name):
    g, r = sets()
    want = plain_score(name, g, r)
    first, second = np.arange(0, 40), np.arange(40, len(g.ids))
    a, b = both(made(name), g, r, order=first), both(made(name), g, r, order=second)
    a.compute()
    for other in (copy.deepcopy(a), a.clone(), pickle.loads(pickle.dumps(a))):
        both(other, g, r, order=second)
        assert same(other.compute(), want)
        assert other.score().n == want.n
    assert a.score().n == 40
    a.merge_state(b)
    assert same(a.compute(), want)
    c = made(name)
    for m in (b, both(made(name), g, r, order=first)):
        c.merge_state(m.metric_state)
    assert same(c.compute(), want)
    with pytest.raises(PalpateError, match="same settings"):
        a.merge_state(made(name, normalize=False))


def test_state_dicts():
    name = "CITMMD"
    g, r = sets()
    metric = both(made(name), g, r)
    assert not metric.state_dict()
    metric.persistent(True)
    fresh = made(name)
    fresh.persistent(True)
    fresh.load_state_dict(metric.state_dict())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torchmetrics: compute before update
        assert same(fresh.compute(), plain_score(name, g, r))


def test_neither_device_nor_type_harms():
    name = "DTMMD"
    g, r = sets()
    for move in (
        lambda m: m.to("cpu"),
        lambda m: m.half(),
        lambda m: m.to(torch.float16),
        lambda m: m.set_dtype(torch.float16),
    ):
        metric = move(both(made(name), g, r, order=np.arange(40)))
        both(metric, g, r, order=np.arange(40, len(g.ids)))
        assert same(metric.compute(), plain_score(name, g, r))
    moved = both(made(name), g, r).to("meta")
    assert moved.settings.device.type == "meta"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_a_gpu():
    g, r = sets()
    want = [both(made(name, streaming), g, r).compute().value for name in NAMES]
    collection = torchmetrics.MetricCollection([made(name) for name in NAMES]).to("cuda")
    for s, real in ((g, False), (r, True)):
        for k in range(0, len(s.ids), 7):
            at = slice(k, k + 7)
            x = torch.tensor(s.features[at], device="cuda")
            collection.update(x, real=real, ids=s.ids[at], labels=s.labels[at], groups=s.groups[at])
    found = collection.compute()
    assert all(v.device.type == "cuda" for v in found.values())
    assert [found[name].item() for name in NAMES] == pytest.approx(want, abs=1e-9)


def test_what_is_rejected():
    with (
        pytest.raises(PalpateError, match="must have generated and real"),
        pytest.warns(UserWarning, match="before the ``update``"),
    ):
        made("TMMD").compute()
    with pytest.raises(PalpateError, match="nonsense"):
        torch_metric.TMMD(nonsense=1)
    metric = torch_metric.TMMD(sync_on_compute=False, compute_with_cache=False)
    assert not metric.sync_on_compute
    g, r = sets()
    both(metric, g, r)
    bad = g.features[:4].copy()
    bad[2] = np.inf
    with pytest.raises(PalpateError, match=r"1 row \(2\)"):
        metric.update(bad, ids=g.ids[:4], labels=g.labels[:4], groups=g.groups[:4])
    assert close(metric.score().to_json(), four_scores(g, r)[0].to_json() | {"encoder": None})
