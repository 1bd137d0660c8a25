"""Frames to a file: MP4, GIF, PNG frames, or one still; written aside and moved into place when done."""

import contextlib
import os
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from ..errors import FilmError

Frame = NDArray[np.uint8]

_STILLS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
_MOST_FRAMES = 1000  # a second


def write(
    path: str | os.PathLike[str],
    frames: Iterable[Frame],
    *,
    fps: float,
    total: int | None = None,
    progress: bool = True,
) -> Path:
    """Write frames (h, w, 3) as they come and return the path; only one is held in memory at a time.

    - `.mp4`: H.264, yuv420p. An odd width or height grows by one repeated column or row, as the format needs.
    - `.gif`: frames wait compressed on disk until the one palette of 256 colours, taken from samples of all
      of them, is known. GIF counts in 1/100 s, so the frame rate is met on average.
    - a pattern such as `shot_%04d.png`, or a folder (a path without suffix): one PNG a frame, from 0.
    - any other picture format of Pillow: one still.

    A file appears under its name only when complete. On Ctrl-C the shorter film is completed and kept, and
    the KeyboardInterrupt goes on, with a note that says so; on any other error nothing is left. `total` is
    the number of frames to come, for the time left on the progress bar, which shows on terminals only.

    Raises FilmError for an unknown suffix, no frames, frames of unequal size, or an unwritable path.
    """
    target = Path(path)
    check_rate(fps)
    writer = _writer_of(target)
    shown = _with_progress(frames, total, target.name) if progress else iter(frames)
    try:
        (target if writer is _write_folder else target.parent).mkdir(parents=True, exist_ok=True)
        writer(target, _checked(shown), fps)
    except OSError as error:
        raise FilmError(f"{target}: cannot be written: {error}") from error
    return target


def check_path(path: str | os.PathLike[str]) -> None:
    """Raise FilmError for a path that no film can have by its ending, or without the library for it."""
    if _writer_of(Path(path)) in (_write_mp4, _write_gif):
        _av()


def _av() -> Any:
    """PyAV. Raises FilmError where it does not load."""
    try:
        import av
        import av.video.reformatter
    except ImportError as error:
        raise FilmError(
            f"films need PyAV, which does not load ({error}): pip install --force-reinstall av; single "
            "frames do without: name a folder, or name_%04d.png"
        ) from error
    return av


def check_rate(fps: float) -> None:
    """Raise FilmError for a number of frames a second that no film has."""
    if not 0 < fps <= _MOST_FRAMES:
        raise FilmError(f"fps must be positive and at most {_MOST_FRAMES}, not {fps:g}")


def _writer_of(target: Path) -> Callable[[Path, Iterator[Frame], float], None]:
    if target.is_dir():
        return _write_folder
    if "%" in target.name:
        return _write_pictures
    ending = target.suffix.lower()
    known = {
        "": _write_folder,
        ".mp4": _write_mp4,
        ".gif": _write_gif,
        **dict.fromkeys(_STILLS, _write_still),
    }
    if ending not in known:
        raise FilmError(
            f"{target}: cannot write {target.suffix!r} files; films: .mp4, .gif, frames as 'name_%04d.png' "
            f"or a folder; stills: {', '.join(_STILLS)}"
        )
    return known[ending]


def _checked(frames: Iterator[Frame]) -> Iterator[Frame]:
    """The frames, each of the first one's size; at least one."""
    size = None
    for number, frame in enumerate(frames):
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise FilmError(f"frame {number} must be (h, w, 3) of uint8, not {frame.shape} of {frame.dtype}")
        size = size or frame.shape
        if frame.shape != size:
            raise FilmError(
                f"frame {number} is {frame.shape[1]}x{frame.shape[0]}, the first was {size[1]}x{size[0]}"
            )
        yield frame
    if size is None:
        raise FilmError("a film needs at least one frame")


@contextlib.contextmanager
def _aside(target: Path) -> Iterator[Path]:
    """A temporary file beside `target` that takes its name at the end, also when Ctrl-C ends it early."""
    handle, name = tempfile.mkstemp(prefix=f".{target.stem}-", suffix=target.suffix, dir=target.parent)
    os.close(handle)
    aside = Path(name)
    try:
        yield aside
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    mask = os.umask(0)
    os.umask(mask)
    aside.chmod(0o666 & ~mask)  # mkstemp's files are for their owner's eyes only
    aside.replace(target)


class _Kept:
    """Context in which Ctrl-C only ends the work, once `frames` have been done; `reraise` lets it go on."""

    def __init__(self) -> None:
        self.frames = 0
        self._interrupt: BaseException | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if isinstance(error, KeyboardInterrupt) and self.frames:
            self._interrupt = error
            return True
        return False

    def reraise(self, target: Path) -> None:
        if self._interrupt is not None:
            self._interrupt.add_note(f"the film so far is {target}")
            raise self._interrupt


def _write_mp4(target: Path, frames: Iterator[Frame], fps: float) -> None:
    av = _av()
    kept = _Kept()
    options = {"movflags": "faststart"}
    with _aside(target) as aside, av.open(str(aside), "w", format="mp4", options=options) as container:
        stream: Any = None
        with kept:
            for frame in frames:
                even = np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), mode="edge")
                if stream is None:
                    stream = container.add_stream("libx264", rate=_rate(fps))
                    stream.height, stream.width = even.shape[:2]
                    stream.pix_fmt = "yuv420p"
                    stream.options = {"crf": "18", "preset": "veryfast"}
                    for name in ("colorspace", "color_primaries", "color_trc"):
                        setattr(stream.codec_context, name, 1)  # BT.709, the colours of clear pictures
                picture = av.VideoFrame.from_ndarray(even, format="rgb24").reformat(
                    format="yuv420p", dst_colorspace=av.video.reformatter.Colorspace.ITU709
                )
                container.mux(stream.encode(picture))
                kept.frames += 1
        container.mux(stream.encode(None))
    kept.reraise(target)


def _write_gif(target: Path, frames: Iterator[Frame], fps: float) -> None:
    from PIL import Image

    av = _av()

    kept = _Kept()
    with _aside(target) as aside, tempfile.TemporaryFile() as spool:
        palette, sizes, shape = _spool(frames, spool, kept)
        colors = np.full((256, 4), 255, dtype=np.uint8)
        listed = np.array(palette.getpalette(), dtype=np.uint8).reshape(-1, 3)
        colors[: len(listed), 1:] = listed
        with av.open(str(aside), "w", format="gif") as container:
            stream: Any = container.add_stream("gif", rate=_rate(fps))
            stream.height, stream.width = shape[:2]
            stream.pix_fmt = "pal8"
            spool.seek(0)
            written = _Kept()
            with written:
                for size in sizes:
                    pixels = np.frombuffer(zlib.decompress(spool.read(size)), dtype=np.uint8).reshape(shape)
                    indexed = Image.fromarray(pixels).quantize(palette=palette)
                    indices: Any = (np.asarray(indexed), colors)
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(indices, format="pal8")))
                    written.frames += 1
            container.mux(stream.encode(None))
    kept.reraise(target)
    written.reraise(target)


def _spool(frames: Iterable[Frame], spool: IO[bytes], kept: _Kept) -> tuple[Any, list[int], tuple[int, ...]]:
    """Store frames compressed; a palette (Pillow image) for them all, their stored sizes, their shape."""
    from PIL import Image

    samples: list[Frame] = []
    sizes: list[int] = []
    shape: tuple[int, ...] = (0, 0, 3)
    stride = 61
    with kept:
        for frame in frames:
            shape = frame.shape
            stored = spool.write(zlib.compress(frame.tobytes(), 1))
            samples.append(frame.reshape(-1, 3)[kept.frames % stride :: stride].copy())
            if sum(map(len, samples)) > 2_000_000:  # a long film: thin the samples, take fewer from now on
                samples, stride = [sample[::2].copy() for sample in samples[::2]], 4 * stride
            sizes.append(stored)
            kept.frames += 1
    pixels = np.concatenate(samples)
    return Image.fromarray(pixels[None]).quantize(256, method=Image.Quantize.MEDIANCUT), sizes, shape


def _write_folder(target: Path, frames: Iterator[Frame], fps: float) -> None:
    _write_pictures(target / "%04d.png", frames, fps)


def _write_pictures(pattern: Path, frames: Iterator[Frame], fps: float) -> None:
    from PIL import Image

    if pattern.suffix.lower() not in _STILLS:
        raise FilmError(f"{pattern}: frames are pictures; end the pattern with {', '.join(_STILLS)}")
    try:
        pattern.name % 0
    except (TypeError, ValueError) as error:
        raise FilmError(
            f"{pattern}: not a pattern for frame numbers ({error}); write e.g. 'shot_%04d.png'"
        ) from error
    for number, frame in enumerate(frames):
        with _aside(pattern.with_name(pattern.name % number)) as aside:
            Image.fromarray(frame).save(aside, compress_level=3)


def _write_still(target: Path, frames: Iterator[Frame], fps: float) -> None:
    from PIL import Image

    frame = next(frames)
    if next(frames, None) is not None:
        raise FilmError(
            f"{target} holds one picture; name the frames of a film '{target.stem}_%04d{target.suffix}'"
        )
    with _aside(target) as aside:
        Image.fromarray(frame).save(aside)


def _rate(fps: float) -> Fraction:
    return Fraction(fps).limit_denominator(1001)


def _with_progress(frames: Iterable[Frame], total: int | None, title: str) -> Iterator[Frame]:
    """The frames, with a bar and the time left on a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(file=sys.stderr)
    if not console.is_terminal:
        yield from frames
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("frames, left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as bar:
        yield from bar.track(frames, total=total, description=f"filming {title}")
