"""The sampler against closed forms, and that a sample depends on its seed and id alone."""

from dataclasses import replace

import pytest
import torch

from palpate.diffusion.denoiser import Denoiser, build_scheduler, guided, sample, starting_noise
from palpate.diffusion.options import ConditionPolicy, SamplerOptions, Schedule, UNetOptions
from palpate.diffusion.unet import build_unet

SHAPE = (3, 4, 4)
TOKENS = torch.zeros(1, 1, 1)
MEAN, SPREAD = 1.7, 0.4


def exact(schedule: Schedule, mean, spread: float):
    """The exact predictor for data N(mean, spread^2): E[eps | z_t]."""
    alphas = schedule.alphas().float()

    def predict(z, t, tokens, background):
        a = alphas[t].reshape(-1, 1, 1, 1)
        m = mean(tokens) if callable(mean) else mean
        return (z - a.sqrt() * m) * (1 - a).sqrt() / (a * spread**2 + 1 - a)

    return predict


@pytest.mark.parametrize(
    ("method", "steps", "tolerance"), [("ddim", 200, 0.02), ("ddim", 1000, 0.01), ("dpm", 20, 0.02)]
)
def test_gaussian_data_come_out_with_their_mean_and_spread(method, steps, tolerance):
    schedule = Schedule()
    ids = [f"s{k}" for k in range(128)]
    noise, options = starting_noise(ids, SHAPE, 0), SamplerOptions(method, steps, 1.0, batch=64)
    predict, scheduler = exact(schedule, MEAN, SPREAD), build_scheduler(schedule, method)
    z = sample(predict, TOKENS.expand(128, 1, 1), noise, options, scheduler)
    # The probability flow of a Gaussian is z^0 = mean + spread * z^T, up to the signal left at T.
    assert float(z.mean()) == pytest.approx(MEAN + SPREAD * float(noise.mean()), abs=tolerance)
    assert float(z.std()) == pytest.approx(SPREAD * float(noise.std()), rel=3 * tolerance)
    assert torch.allclose(z, MEAN + SPREAD * noise, atol=0.1)


def test_guidance_extrapolates_from_the_unconditional_prediction():
    """Equal spreads, means 0 (null) and m: the guided prediction is that of the mean s m."""
    schedule = Schedule()
    predict = exact(schedule, lambda tokens: tokens.reshape(-1, 1, 1, 1), 0.5)
    noise, scheduler = (
        starting_noise([*map(str, range(32))], SHAPE, 1),
        build_scheduler(schedule, "ddim"),
    )
    for s in (0.0, 1.0, 3.0):
        options = SamplerOptions("ddim", 200, guidance=s, batch=16)
        z = sample(predict, torch.full((32, 1, 1), 0.8), noise, options, scheduler)
        expected = s * 0.8 + 0.5 * float(noise.mean())
        assert float(z.mean()) == pytest.approx(expected, abs=0.03)


def test_ddim_step_by_hand():
    """One deterministic DDIM step: z_{t-1} = sqrt(a') x0 + sqrt(1 - a') eps."""
    schedule = Schedule()
    scheduler = build_scheduler(schedule, "ddim")
    scheduler.set_timesteps(10)
    times = scheduler.timesteps.tolist()
    assert times[0] == 999
    a = schedule.alphas()
    z, eps = torch.randn(2, 3, 4, 4), torch.randn(2, 3, 4, 4)
    x0 = (z - (1 - a[999]).sqrt() * eps) / a[999].sqrt()
    wanted = a[899].sqrt() * x0 + (1 - a[899]).sqrt() * eps
    assert times[1] == 899
    assert torch.allclose(
        scheduler.step(eps, 999, z).prev_sample.double(), wanted.double(), rtol=1e-3, atol=1e-3
    )


def test_noise_belongs_to_seed_and_id():
    a = starting_noise(["x", "y"], SHAPE, 0)
    assert torch.equal(starting_noise(["y"], SHAPE, 0)[0], a[1])
    assert not torch.equal(a[0], a[1])
    assert not torch.equal(starting_noise(["x"], SHAPE, 1)[0], a[0])
    many = starting_noise([str(k) for k in range(500)], SHAPE, 0)
    assert abs(float(many.mean())) < 0.02
    assert float(many.std()) == pytest.approx(1, abs=0.02)


def network() -> Denoiser:
    torch.manual_seed(0)
    options = UNetOptions(widths=(8, 16), attention=(False, True), layers=1, head_width=8, groups=4)
    policy = ConditionPolicy(width=12)
    return Denoiser(build_unet(options, policy, channels=3, size=8), policy).eval()


def draw(model: Denoiser, conditions, ids, **changes) -> torch.Tensor:
    options = replace(SamplerOptions("dpm", 4, guidance=3.0, batch=4), **changes)
    noise, scheduler = starting_noise(ids, (3, 8, 8), 0), build_scheduler(Schedule(), "dpm")
    return sample(model, model.tokens(conditions, "vision"), noise, options, scheduler)


def test_a_sample_does_not_depend_on_its_neighbors():
    model = network()
    torch.manual_seed(1)
    c = torch.randn(7, 12)
    ids = [f"id {k}" for k in range(7)]
    whole = draw(model, c, ids)
    order = [4, 1, 6, 0]
    # At one batch size, other neighbors and places change no bit.
    assert torch.equal(draw(model, c[order], [ids[k] for k in order]), whole[order])
    assert torch.equal(draw(model, c[3:4], ids[3:4])[0], whole[3])
    # Another batch size may pick other kernels: equal up to rounding.
    for batch in (1, 3, 7, 16):
        assert torch.allclose(
            draw(model, c, ids, batch=batch), whole, rtol=1e-4, atol=1e-5 * float(whole.abs().max())
        )


def test_guidance_changes_the_output():
    model = network()
    c = torch.randn(2, 12)
    outputs = [draw(model, c, ["a", "b"], guidance=s) for s in (0.0, 1.0, 2.0, 7.5)]
    for k, one in enumerate(outputs):
        for other in outputs[k + 1 :]:
            assert not torch.allclose(one, other, atol=1e-4)
    # Without guidance the unconditional pass is not made, yet the formula holds.
    both = draw(model, c, ["a", "b"], guidance=1.0 + 1e-9)
    assert torch.allclose(both, outputs[1], atol=1e-4)


def test_rescaling_keeps_the_spread_of_the_conditional_prediction():
    seen = []

    def predict(z, t, tokens, background):
        out = z * torch.where(tokens == 0, 0.5, 1.0).reshape(-1, 1, 1, 1)
        seen.append(out)
        return out

    z, t = torch.randn(2, 3, 4, 4), torch.tensor([5, 5])
    out = guided(
        predict, z, t, torch.ones(2, 1, 1), None, SamplerOptions(guidance=4.0, rescale=1.0)
    )
    assert torch.allclose(out.std((1, 2, 3)), z.std((1, 2, 3)), rtol=1e-5)
    assert torch.allclose(out / out.std(), z / z.std(), atol=1e-5)
