"""Video frames: exact numbers against a full decode, and files that are cut."""

import sys

import numpy as np
import pytest

from forge.errors import fails
from forge.pictures import number, write_video
from palpate.core import MissingExtraError, PalpateError
from palpate.data.video import VideoReader

av = pytest.importorskip("av", reason="PyAV is not installed")

KINDS = {
    "b-frames": {},
    "late start": {"start": 17},
    "one keyframe": {"gop": 250},
    "no b-frames": {"b_frames": 0},
    "open gop": {"gop": 10, "options": {"x264-params": "open-gop=1:keyint=10:bframes=4:b-adapt=0"}},
    "mpeg4": {"codec": "mpeg4", "b_frames": 2},
}


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
@pytest.mark.parametrize("kind", KINDS)
def test_frames_are_those_of_a_full_decode_in_any_order(tmp_path, kind, suffix):
    path = write_video(tmp_path / f"v.{suffix}", 60, **KINDS[kind])
    with av.open(str(path)) as file:
        full = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    assert [number(a) for a in full] == list(range(60))
    order = np.random.default_rng(1).integers(0, 60, 50).tolist()
    with VideoReader(path) as reader:
        assert len(reader) == 60
        for k in [59, 0, 59, 58, *order]:
            assert np.array_equal(reader[k], full[k]), k
        wanted = [0, 1, 1, 5, 30, 31, 59]
        assert [(k, number(a)) for k, a in reader.frames(wanted)] == [(k, k) for k in wanted]
    with VideoReader(path) as reader:
        assert all(np.array_equal(a, full[k]) for k, a in reader.frames(range(60)))


def test_sorted_frames_are_decoded_in_one_pass(tmp_path, monkeypatch):
    path = write_video(tmp_path / "v.mp4", 60, gop=250, options={"x264-params": "scenecut=0"})
    with VideoReader(path) as reader:
        seeks = []
        original = reader._seek
        monkeypatch.setattr(reader, "_seek", lambda t: (seeks.append(t), original(t)))
        list(reader.frames([2, 3, 20, 49]))
        assert len(seeks) == 1


def test_numbers_outside_are_rejected(tmp_path):
    with VideoReader(write_video(tmp_path / "v.mp4", 5)) as reader:
        for k in (5, -1):
            with pytest.raises(PalpateError, match="between 0 and 4"):
                reader[k]


def test_cut_files_are_rejected_with_counts(tmp_path):
    data = write_video(tmp_path / "v.mp4", 60).read_bytes()
    cut = tmp_path / "cut.mp4"
    counts = {len(data) // 2: "of 60 declared", len(data) - 1: "59 readable of 60"}
    for length, message in {0: "0 bytes", 40: "cut short", **counts}.items():
        cut.write_bytes(data[:length])
        fails(message, VideoReader, cut)
    # The index at the end of the file, as a camera writes it, and lost with the end.
    with av.open(str(tmp_path / "v.mp4")) as source, av.open(str(tmp_path / "end.mp4"), "w") as out:
        stream = out.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    data = (tmp_path / "end.mp4").read_bytes()
    with VideoReader(tmp_path / "end.mp4") as reader:
        assert number(reader[41]) == 41
    cut.write_bytes(data[: len(data) // 2])
    fails("cut short", VideoReader, cut)
    fails("no file", VideoReader, tmp_path / "none.mp4")
    cut.write_bytes(b"words")
    fails("whole and readable", VideoReader, cut)


def test_media_overwritten_in_the_middle_is_reported_while_decoding(tmp_path):
    path = write_video(tmp_path / "v.mp4", 60, codec="mpeg4", b_frames=0)
    data = bytearray(path.read_bytes())
    with av.open(str(path)) as file:
        start = min(p.pos for p in file.demux(video=0) if p.pos is not None and p.size)
    data[start:] = bytes(len(data) - start)
    path.write_bytes(bytes(data))
    with VideoReader(path) as reader, pytest.raises(PalpateError, match=r"v\.mp4"):
        list(reader.frames([40]))


def test_without_av_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"\[video\]"):
        VideoReader(tmp_path / "v.mp4")
