"""TMMD as torchmetrics.Metric: processes, collections, forward, state dicts."""

import copy
import pickle
import warnings

import numpy as np
import pytest

torch = pytest.importorskip("torch")
torchmetrics = pytest.importorskip("torchmetrics")

from palpate.core import PalpateError  # noqa: E402
from palpate.metrics import streaming, tmmd, torch_metric  # noqa: E402
from test_metrics_streaming import both, close, feed, sets  # noqa: E402


def plain_score(g, r, **options):
    return both(streaming.TMMD(), g, r, **options).compute()


def same(tensor, score):
    return tensor.item() == pytest.approx(score.value, abs=1e-9)


def test_a_true_metric_with_the_same_score():
    g, r = sets()
    metric = both(torch_metric.TMMD(), g, r)
    want = plain_score(g, r)
    assert isinstance(metric, torchmetrics.Metric)
    assert {metric.higher_is_better, metric.is_differentiable, metric.full_state_update} == {False}
    value = metric.compute()
    assert (value.dtype, value.ndim) == (torch.float64, 0)
    assert same(value, want)
    assert close(metric.score().to_json(), want.to_json())
    before = metric.update_count
    assert hash(metric) == hash(metric)  # so that a module that holds it finds it again
    metric.update(np.zeros((0, 6)))
    assert metric.update_count == before + 1
    assert same(metric.compute(), want)


def test_two_gloo_processes_give_what_one_gives(on_two_processes):
    """The second of two processes gets a quarter of the rows, and no real ones."""
    g, r = sets()
    cut = 3 * len(g.ids) // 4

    def share_of_rows():
        number, metric = torch.distributed.get_rank(), torch_metric.TMMD()
        mine = np.arange(cut) if number == 0 else np.arange(cut, len(g.ids))
        feed(metric, g, order=mine, step=5 + number)
        if number == 0:
            feed(metric, r, real=True)
        synced = metric.compute().item(), metric.score().to_json()
        # unsynchronized again
        rows = metric.plain.compute().n if number == 0 else None
        metric.update(g.features[:0])
        return *synced, rows, metric.compute().item()

    results, want = on_two_processes(share_of_rows), plain_score(g, r)
    for value, score, _, later in results:
        assert value == pytest.approx(want.value, abs=1e-9)
        assert later == value
        assert close(score, want.to_json())
    assert results[0][2] == cut


def test_processes_of_different_settings_are_refused(on_two_processes):
    def other_settings():
        metric = both(torch_metric.TMMD(encoder=str(torch.distributed.get_rank())), *sets())
        try:
            return str(metric.compute())
        except PalpateError as error:
            return str(error)

    assert any("same settings" in text for text in on_two_processes(other_settings))


def test_a_collection_may_be_called_and_may_keep_real_samples():
    g, r = sets()
    collection = torchmetrics.MetricCollection([torch_metric.TMMD(reset_real_features=False)])
    feed(collection, r, real=True)
    for _ in range(2):
        for k in range(0, len(g.ids), 30):
            at = slice(k, k + 30)
            collection(g.features[at], ids=g.ids[at], groups=g.groups[at])
        assert same(collection.compute()["TMMD"], plain_score(g, r))
        collection.reset()


def test_forward_gives_the_batch_and_adds_it_once():
    g, r = sets()
    metric = torch_metric.TMMD(reset_real_features=False)
    assert metric(r.features, real=True, groups=r.groups, ids=r.ids).isnan()
    half = np.arange(40)
    columns = lambda at: {"ids": [g.ids[k] for k in at], "groups": [g.groups[k] for k in at]}
    first = metric(g.features[half], **columns(half))
    want = both(streaming.TMMD(), g, r, order=half).compute()
    alone = streaming.TMMD()
    feed(feed(alone, g, order=half), r, real=True)
    assert same(first, alone.compute())
    assert not same(first, want)  # fewer real ones
    rest = np.arange(40, len(g.ids))
    metric(g.features[rest], **columns(rest))
    assert same(metric.compute(), plain_score(g, r))
    metric.reset()
    assert metric(r.features[:0]).isnan()
    metric(features=g.features, **columns(range(len(g.ids))))
    assert same(metric.compute(), plain_score(g, r))


def test_copies_pickles_and_merges():
    g, r = sets()
    want = plain_score(g, r)
    first, second = np.arange(0, 40), np.arange(40, len(g.ids))
    a, b = (
        both(torch_metric.TMMD(), g, r, order=first),
        both(torch_metric.TMMD(), g, r, order=second),
    )
    a.compute()
    for other in (copy.deepcopy(a), a.clone(), pickle.loads(pickle.dumps(a))):
        both(other, g, r, order=second)
        assert same(other.compute(), want)
        assert other.score().n == want.n
    assert a.score().n == 40
    a.merge_state(b)
    assert same(a.compute(), want)
    c = torch_metric.TMMD()
    for m in (b, both(torch_metric.TMMD(), g, r, order=first)):
        c.merge_state(m.metric_state)
    assert same(c.compute(), want)
    with pytest.raises(PalpateError, match="same settings"):
        a.merge_state(torch_metric.TMMD(normalize=False))


def test_state_dicts():
    g, r = sets()
    metric = both(torch_metric.TMMD(), g, r)
    assert not metric.state_dict()
    metric.persistent(True)
    fresh = torch_metric.TMMD()
    fresh.persistent(True)
    fresh.load_state_dict(metric.state_dict())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torchmetrics: compute before update
        assert same(fresh.compute(), plain_score(g, r))


def test_neither_device_nor_type_harms():
    g, r = sets()
    for move in (
        lambda m: m.to("cpu"),
        lambda m: m.half(),
        lambda m: m.to(torch.float16),
        lambda m: m.set_dtype(torch.float16),
    ):
        metric = move(both(torch_metric.TMMD(), g, r, order=np.arange(40)))
        both(metric, g, r, order=np.arange(40, len(g.ids)))
        assert same(metric.compute(), plain_score(g, r))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_a_gpu():
    g, r = sets()
    metric = torch_metric.TMMD().to("cuda")
    for features, real in ((g, False), (r, True)):
        for k in range(0, len(features.ids), 7):
            at = slice(k, k + 7)
            x = torch.tensor(features.features[at], device="cuda")
            metric.update(x, real=real, ids=features.ids[at], groups=features.groups[at])
    value = metric.compute()
    assert value.device.type == "cuda"
    assert same(value, plain_score(g, r))


def test_what_is_rejected():
    with (
        pytest.raises(PalpateError, match="must have generated and real"),
        pytest.warns(UserWarning, match="before the ``update``"),
    ):
        torch_metric.TMMD().compute()
    with pytest.raises(PalpateError, match="nonsense"):
        torch_metric.TMMD(nonsense=1)
    metric = torch_metric.TMMD(sync_on_compute=False, compute_with_cache=False)
    assert not metric.sync_on_compute
    g, r = sets()
    both(metric, g, r)
    with pytest.raises(PalpateError, match="Give each always, or never"):  # the last were real
        metric.update(g.features[:4], ids=g.ids[:4])
    assert close(metric.score().to_json(), tmmd(g, r).to_json() | {"encoder": None})
