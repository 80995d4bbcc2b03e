"""Contacts found in tactile videos: the untouched gel, the presses, the background of each."""

import numpy as np
import pytest

from palpate.data.contacts import contact_energy, find_contacts, find_reference
from palpate.data.streams import findings
from palpate.data.video import VideoReader


def gel_video(length=120, presses=((20, 40), (60, 90)), strength=20.0, seed=0):
    """(n, 48, 64, 3): a gel with noise; presses rise in 5 frames, each with its own print."""
    rng = np.random.default_rng(seed)
    gel = 120 + 10 * rng.normal(0, 1, (6, 8, 3)).repeat(8, 0).repeat(8, 1)
    video = np.repeat(gel[None], length, 0)
    for first, last in presses:
        print_ = rng.normal(0, 1, (6, 8, 3)).repeat(8, 0).repeat(8, 1)
        for k in range(max(0, first - 5), min(length, last + 6)):
            near = min(k - first, last - k, 0) / 6 + 1
            video[k] += strength * near * print_ * (1 + 0.1 * np.sin(k))
    video += rng.normal(0, 1, video.shape)
    return np.clip(video, 0, 255).astype(np.uint8)


def overlap(found, true):
    """Intersection over union of two runs."""
    both = min(found[1], true[1]) - max(found[0], true[0]) + 1
    return max(0, both) / (max(found[1], true[1]) - min(found[0], true[0]) + 1)


@pytest.mark.parametrize(
    ("presses", "length"),
    [
        (((20, 40), (60, 90)), 120),
        (((0, 30), (60, 80)), 120),  # pressed from the first frame
        (((30, 50), (100, 119)), 120),  # and to the last
        (((15, 50), (75, 105)), 120),  # in contact most of the time
        ((), 120),
    ],
)
@pytest.mark.parametrize("strength", [4.0, 40.0])
def test_presses_are_found_with_the_gel_before_them(presses, length, strength):
    video = gel_video(length, presses, strength)
    contacts = find_contacts(video)
    assert len(contacts.runs) == len(presses)
    touched = {k for first, last in presses for k in range(first - 3, last + 4)}
    assert touched.isdisjoint([contacts.reference, *contacts.backgrounds])
    for found, true, background in zip(contacts.runs, presses, contacts.backgrounds, strict=True):
        assert overlap(found, true) > 0.6
        if true[0] > 5:
            assert true[0] - 20 < background < found[0]


def test_a_weak_press_after_a_strong_one_and_a_gel_that_relaxes_slowly():
    video = gel_video(160, ((20, 40),), 20).astype(float)
    rng = np.random.default_rng(1)
    relaxing = rng.normal(0, 4, (3, 4, 3)).repeat(16, 0).repeat(16, 1)
    video[41:] += relaxing  # the gel is another one after the press
    video[100:130] += 12 * rng.normal(0, 1, (6, 8, 3)).repeat(8, 0).repeat(8, 1)
    runs = find_contacts(np.clip(video, 0, 255).astype(np.uint8)).runs
    assert [
        overlap(run, true) > 0.7 for run, true in zip(runs, ((18, 42), (100, 129)), strict=True)
    ]


def test_a_declared_gel_finds_a_press_that_is_held_longer_than_the_gel_is_free():
    video = gel_video(60, ((8, 58),))
    video[8:59] = video[30]
    contacts = find_contacts(video, gel=gel_video(1, ())[0])
    assert [overlap(run, (8, 58)) > 0.9 for run in contacts.runs] == [True]
    assert contacts.backgrounds[0] < 8


def test_a_declared_reference_is_used_and_brightness_is_no_contact():
    video = gel_video(60, ((0, 59),))
    assert find_contacts(video, reference=7).reference == 7
    energy = contact_energy(video[:1] // 2 + np.array([[40]], np.uint8), video[0] // 2)
    assert energy[0] < 0.01


@pytest.mark.parametrize("length", [1, 2, 3])
def test_short_videos_have_a_reference(length):
    video = gel_video(length, ())
    assert find_reference(video) < length
    assert find_contacts(video).runs == []


@pytest.fixture
def clips(real_data):
    return real_data / "touch_and_go" / "clips"


def measured(folder, name):
    with VideoReader(folder / "dataset" / name / "gelsight.mp4") as reader:
        contacts = find_contacts(reader.thumbnails())
    lines = (folder / "label.txt").read_text().split()
    labeled = {int(line[16:26]) for line in lines if line.startswith(name)}
    return contacts, labeled


@pytest.mark.parametrize(
    ("name", "precision", "recall", "contacts"),
    [
        ("clip_brick_0001", 0.63, 0.99, 2),  # a third, soft press is not labeled
        ("clip_concrete_0", 0.95, 0.95, 3),
        ("clip_grass_0001", 0.70, 0.95, 2),  # the first of three is labeled for 6 frames
        ("clip_stone_0001", 0.95, 0.95, 6),
        ("clip_wood_00001", 0.95, 0.85, 3),
    ],
)
def test_labeled_contacts_of_real_clips_are_found(clips, name, precision, recall, contacts):
    found, labeled = measured(clips, name)
    frames = {k for first, last in found.runs for k in range(first, last + 1)}
    assert len(frames & labeled) / len(frames) >= precision
    assert len(frames & labeled) / len(labeled) >= recall
    breaks = [k for k in sorted(labeled) if k - 1 not in labeled]
    ends = [k for k in sorted(labeled) if k + 1 not in labeled]
    true = list(zip(breaks, ends, strict=True))
    assert sum(any(overlap(run, t) >= 0.5 for run in found.runs) for t in true) == contacts
    assert labeled.isdisjoint([found.reference, *found.backgrounds])


# --- Streams


def photos(length=120, events=((20, 40), (60, 90)), seed=3):
    """(n, 48, 64, 3): a scene that moves while a press begins and ends."""
    rng = np.random.default_rng(seed)
    scene = rng.integers(60, 190, (48, 90, 3))
    moving = {k for first, last in events for k in (first - 3, first - 2, last + 2, last + 3)}
    shifts = np.cumsum([k in moving for k in range(length)])
    video = np.stack([scene[:, s : s + 64] for s in shifts])
    return np.clip(video + rng.normal(0, 2, video.shape), 0, 255).astype(np.uint8)


def shifted(video, frames):
    """The same video, its content so many frames later."""
    return np.concatenate([np.repeat(video[:1], frames, 0), video[: len(video) - frames]])


EVENTS = ((21, 40), (53, 97), (110, 161))
TIMES = np.arange(200) / 30


def kinds(tactile, vision=None, /, **seconds):
    videos = {"tactile": tactile} | ({} if vision is None else {"vision": vision})
    return dict(findings(videos, seconds))


def test_sound_streams_raise_no_suspicion():
    assert kinds(gel_video(200, EVENTS), photos(200, EVENTS), tactile=TIMES, vision=TIMES) == {}
    assert kinds(gel_video(200, EVENTS)) == {}
    assert kinds(gel_video(3, ())) == {}


@pytest.mark.parametrize("lag", [6, 12, 33])
def test_a_lag_is_found_with_its_sign(lag):
    tactile, vision = gel_video(200, EVENTS), photos(200, EVENTS)
    late, early = kinds(shifted(tactile, lag), vision), kinds(tactile, shifted(vision, lag))
    assert late["lag"].startswith(f"tactile changes {lag} frames after")
    assert early["lag"].startswith(f"tactile changes {lag} frames before")


def test_a_frozen_stream_is_found():
    tactile = gel_video(200, EVENTS)
    tactile[120:160] = tactile[120]
    assert kinds(tactile)["frozen-stream"].startswith("frames 120 to 159 of tactile")
    assert "frozen-stream" in kinds(gel_video(200, EVENTS), np.repeat(photos(1), 200, 0))


def test_dropped_frames_and_unequal_streams_are_found():
    tactile, vision = gel_video(200, EVENTS), photos(200, EVENTS)
    leaps = TIMES + 3 / 30 * (np.arange(200) > 80)
    text = kinds(tactile, tactile=leaps)["dropped-frames"]
    assert "lacks 3 frames at 1 place, the first after frame 80" in text
    assert "200 frames" in kinds(tactile, vision[:150])["unequal-streams"]
    rates = kinds(tactile, vision, tactile=TIMES, vision=TIMES * 30 / 25)["unequal-streams"]
    assert "30 frames a second in tactile and 25 frames a second in vision" in rates
    variable = np.cumsum(np.random.default_rng(0).choice([1 / 60, 1 / 30, 1 / 15], 200))
    assert kinds(tactile, tactile=variable) == {}
