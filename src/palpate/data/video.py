"""Frames of a video file by their exact number.

Frame ``k`` is the ``k``-th image in order of presentation, as a full decode would count it. The
timestamps of all packets are read first (a pass over the file without decoding); sorted, they are
the index: ``pts[k]``. To reach frame ``k`` the reader seeks to the last keyframe presented at or
before ``pts[k]`` and decodes until exactly that timestamp; where decoding is already between that
keyframe and ``k``, it continues from there. Rates and durations are not used, so B-frames, variable
rates and clips that do not start at zero are exact.

A display matrix (of a phone that was held upright) turns or mirrors the frames: a pixel (x, y) is
shown at (a x + c y, b x + d y), its first two rows being (a, b) and (c, d).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.core import MissingExtraError, PalpateError, require
from palpate.data.contacts import SIZE

REWRITE = "Write it as MP4 again: ffmpeg -i FILE -c copy NEW.mp4"


class VideoReader:
    """A video file as a sequence of RGB images.

    ``len(reader)``, ``reader[k]`` and ``reader.frames([3, 4, 90])`` use exact frame numbers.
    Use one reader per thread, as a context manager or with :meth:`close`.

    Args:
        path: the file.

    Attributes:
        turned: whether frames that were read were turned or mirrored by a display matrix.

    Raises:
        MissingExtraError: if PyAV is not installed.
        PalpateError: if the file is missing, no video, cut short, or without timestamps.
    """

    turned = False

    def __init__(self, path: Path) -> None:
        try:
            import av
            from av.error import FFmpegError
        except ImportError:
            raise MissingExtraError("av", "video", "Reading video files") from None
        self.path = Path(path)
        self._errors: tuple[type[Exception], ...] = (FFmpegError, OSError)
        got = f"no file {self.path}"
        require(self.path.is_file(), None, "The video must exist", got, fix="Check the path")
        try:
            self._container: Any = av.open(str(self.path), metadata_errors="replace")
        except self._errors as error:
            got = "an empty file (0 bytes)" if self.path.stat().st_size == 0 else _reason(error)
            raise self._broken(f"{got}: it is cut short, or no video") from None
        try:
            if not self._container.streams.video:
                raise self._broken("a file without images: it is cut short, or no video")
            self._stream: Any = self._container.streams.video[0]
            self._stream.thread_type = "AUTO"
            self._pts, self._keys = self._index()
        except BaseException:
            self.close()
            raise
        self._decoded: Iterator[Any] | None = None
        self._last: tuple[int, NDArray[np.uint8]] | None = None

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._pts)

    def __getitem__(self, k: int) -> NDArray[np.uint8]:
        """Frame ``k`` (from 0) as (h, w, 3), 0 to 255.

        Raises:
            PalpateError: if ``k`` lies outside the video, or the file breaks off before it.
        """
        must = f"A frame of {self.path} must lie between 0 and {len(self) - 1}"
        fix = "Take the numbers from this video's list"
        require(0 <= k < len(self), None, must, str(k), fix=fix)
        if self._last is None or self._last[0] != k:
            self._last = (k, self._reach(k))
        return self._last[1]

    def frames(self, indices: Iterable[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield ``(k, (h, w, 3) image)`` as given; rising numbers are decoded in one pass."""
        for k in indices:
            yield k, self[k]

    @property
    def seconds(self) -> NDArray[np.float64]:
        """(n,) when each frame is presented."""
        return np.asarray(self._pts) * float(self._stream.time_base or 1)

    def thumbnails(self) -> NDArray[np.uint8]:
        """All frames, reduced to (n, 48, 64, 3) while they are decoded."""
        from av.video.reformatter import Interpolation, VideoReformatter

        images = np.empty((len(self), *SIZE[::-1], 3), np.uint8)
        resize, position = VideoReformatter().reformat, {pts: k for k, pts in enumerate(self._pts)}
        area = Interpolation.AREA
        self._last = None
        self._seek(self._keys[0][1] if self._keys else self._pts[0])
        assert self._decoded is not None
        try:
            for frame in self._decoded:
                if (k := position.pop(frame.pts, None)) is not None:
                    width, height = SIZE[::-1] if self._matrix(frame)[1] else SIZE
                    image = resize(frame, width, height, "rgb24", interpolation=area)
                    images[k] = self._upright(frame, np.asarray(image.to_ndarray(), np.uint8))
        except self._errors as error:
            raise self._broken(f"a frame that cannot be decoded ({_reason(error)})") from None
        if position:
            k = min(position.values())
            raise self._broken(f"frame {k} of {len(self)} cannot be decoded")
        return images

    def close(self) -> None:
        """Close the file."""
        self._decoded = None
        self._container.close()

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _index(self) -> tuple[list[int], list[tuple[int, int]]]:
        """Sorted timestamps of the frames, and sorted (pts, dts) of the keyframes."""
        times: list[int] = []
        keys: list[tuple[int, int]] = []
        count = cut = 0
        # Where the index of the container is readable it counts what is presented; the header's
        # count may include frames that an edit list removed.
        declared = len(getattr(self._stream, "index_entries", None) or ()) or self._stream.frames
        try:
            for packet in self._container.demux(self._stream):
                count += packet.size > 0
                cut += packet.is_corrupt and packet.size > 0
                # A discarded packet is needed to decode what follows, but never presented.
                if packet.size == 0 or packet.is_discard:
                    continue
                if packet.pts is None:
                    raise self._broken("frames without timestamps", REWRITE)
                times.append(packet.pts)
                if packet.is_keyframe:
                    keys.append((packet.pts, packet.pts if packet.dts is None else packet.dts))
        except self._errors as error:
            total = declared or "an unknown number of"
            got = f"{count} readable of {total} frames ({_reason(error)})"
            raise self._broken(got) from None
        if count - cut < declared:
            got = f"{count - cut} readable of {declared} declared frames: the file is cut short"
            raise self._broken(got)
        if not times:
            raise self._broken("0 frames")
        if len(set(times)) < len(times):
            raise self._broken("two frames with one timestamp", REWRITE)
        return sorted(times), sorted(keys)

    def _reach(self, k: int) -> NDArray[np.uint8]:
        """Decode until frame ``k``."""
        target = self._pts[k]
        key = bisect_right(self._keys, target, key=lambda pair: pair[0]) - 1
        last = self._last[0] if self._last is not None else k
        if last < k and self._pts[last] >= self._keys[max(key, 0)][0]:
            image = self._until(target)
            if image is not None:
                return image
        # The demuxer may land on a later keyframe, or fail to decode one: then try earlier ones.
        for _, time in [*reversed(self._keys[: key + 1]), (0, self._pts[0])]:
            self._seek(time)
            image = self._until(target)
            if image is not None:
                return image
        raise self._broken(f"frame {k} of {len(self)} cannot be decoded")

    def _seek(self, time: int) -> None:
        try:
            self._container.seek(time, stream=self._stream, backward=True)
        except self._errors as error:
            raise self._broken(_reason(error)) from None
        self._decoded = self._container.decode(self._stream)

    def _until(self, target: int) -> NDArray[np.uint8] | None:
        """The frame with timestamp ``target``, or None if decoding does not meet it."""
        assert self._decoded is not None
        try:
            for frame in self._decoded:
                if frame.pts == target:
                    return self._upright(frame, frame.to_ndarray(format="rgb24"))
                if frame.pts is not None and frame.pts > target:
                    return None
        except self._errors as error:
            raise self._broken(f"a frame that cannot be decoded ({_reason(error)})") from None
        return None

    def _matrix(self, frame: Any) -> tuple[int, int, int, int]:
        """Signs of a, b, c and d of a frame's display matrix; that of no turn if it has none."""
        data = frame.side_data.get("DISPLAYMATRIX")
        if data is None:
            return 1, 0, 0, 1
        (a, b, _), (c, d, _), _ = np.sign(np.frombuffer(data, np.int32).reshape(3, 3)).tolist()
        if not ((a and d and not b and not c) or (b and c and not a and not d)):
            raise self._broken("a display matrix that is no quarter turn", REWRITE)
        return a, b, c, d

    def _upright(self, frame: Any, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image (h, w, 3) of a frame as its display matrix shows it."""
        a, b, c, d = self._matrix(frame)
        self.turned |= (a, d) != (1, 1)
        image = image.transpose(1, 0, 2) if b else image
        return np.ascontiguousarray(image[:: b or d, :: c or a])

    def _broken(self, got: str, fix: str = "Fetch the file again") -> PalpateError:
        return PalpateError(f"The video {self.path} must be whole and readable", got, fix)


def write_video(
    path: Path,
    images: Iterable[NDArray[np.uint8]],
    rate: Fraction,
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write uint8 images (h, w, 3) as H.264, constant rate factor 18, so that bytes repeat.

    One thread; x264 without the code whose rounding depends on the processor; frames converted
    before they reach the encoder, because its conversion makes its decisions differ from run to
    run.

    Args:
        path: of the MP4.
        images: of one size, of even sides.
        rate: images a second.
        metadata: tags of the file.

    Raises:
        MissingExtraError: if PyAV is not installed.
    """
    try:
        import av
    except ImportError:
        raise MissingExtraError("av", "video", "Writing video files") from None
    with av.open(str(path), "w", format="mp4") as file:
        file.metadata.update(metadata or {})
        settings = {"crf": "18", "preset": "veryfast", "x264-params": "cpu-independent=1"}
        stream = file.add_stream("libx264", rate=rate, options=settings)
        stream.pix_fmt, stream.thread_count, stream.time_base = "yuv420p", 1, 1 / rate
        for number, image in enumerate(images):
            if not number:
                stream.height, stream.width = image.shape[:2]
            frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="yuv420p")
            file.mux(stream.encode(frame))
        file.mux(stream.encode())


def _reason(error: BaseException) -> str:
    """The message of FFmpeg without the file name."""
    return str(getattr(error, "strerror", None) or error).split(";")[0]
