# SPDX-License-Identifier: Apache-2.0
"""Opens a pair of files, maps the layers of its views, and names the files that a frame is made from."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from oiio_msspl.aovs.additive_sets import AdditiveSet
from oiio_msspl.aovs.candidates import mapped_files
from oiio_msspl.aovs.features import ALBEDO, NORMAL, RGB
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.aovs.mapping import split_exr
from oiio_msspl.aovs.matching import map_render
from oiio_msspl.aovs.renderers import aov_files
from oiio_msspl.aovs.views import name_of
from oiio_msspl.errors import InputError
from oiio_msspl.exr.contents import dropped_channels
from oiio_msspl.exr.layers import layer_by_channel
from oiio_msspl.exr.reader import ExrFile, open_exr
from oiio_msspl.exr.write_options import WriteOptions
from oiio_msspl.fusion.tiles.alignment import align
from oiio_msspl.image.colour import REC709, SPACES, ColourSpace, encoding_of, named_space, same_space, space_of
from oiio_msspl.jobs.sequence import frame_in_name, is_sequence, parse_pattern


@dataclass(frozen=True)
class InputOptions:
    """Facts about the two files that they do not say themselves."""

    mapping: Mapping[str, Any] = field(default_factory=dict)
    """The user's own layer for each feature, see :func:`oiio_msspl.aovs.matching.map_render`. The names of files may be
    patterns such as ``albedo.####.exr``."""
    view: str | None = None
    """The only view or view layer to use; None for all, the HRLS's first one in front."""
    lr_spp: float | None = None
    """Samples per pixel of the LRHS; None to read them from its header."""
    hr_spp: float | None = None
    """Samples per pixel of the HRLS; None to read them from its header."""
    colourspace: str | None = None
    """Linear RGB space of both renders, see :func:`oiio_msspl.image.colour.named_space`; None to read it from the
    headers, and to take linear Rec. 709 if they do not say."""
    sums: tuple[str, ...] = ()
    """The user's additive sets, as ``NAME=a+b+c*d``."""
    map_file: Path | None = None
    """The file that ``mapping`` was read from, if any."""

    def __post_init__(self) -> None:
        if isinstance(self.sums, str):
            raise InputError(f"--sum {self.sums!r}: give a tuple, such as ({self.sums!r},)")
        for option, spp in (("--lr-spp", self.lr_spp), ("--hr-spp", self.hr_spp)):
            if spp is not None and not 0 < spp < math.inf:
                raise InputError(f"{option} {spp:g}: give the samples per pixel, a number above 0")

    def files(self, hr_path: Path, model: str | None) -> set[Path]:
        """Return the files that a frame is made from beside the pair: those of the mapping, and a user's model."""
        named = [self.map_file, None if model is None else Path(model)]
        return mapped_files(self.mapping_of(hr_path), hr_path) | {path for path in named if path is not None}

    def mapping_of(self, hr_path: Path) -> dict[str, Any]:
        """Return the mapping with the files of the frame whose HRLS this is in the place of patterns.

        Raises:
            InputError: there is a pattern, and the name of the HRLS has no frame number.
        """
        return {feature: _file_of_frame(candidate, hr_path) for feature, candidate in self.mapping.items()}


def _file_of_frame(value: Any, hr_path: Path) -> Any:
    """Return a candidate, or a part of one, with the file of a frame in the place of a pattern."""
    if isinstance(value, Mapping):
        return {key: _file_of_frame(element, hr_path) for key, element in value.items()}
    if isinstance(value, list):
        return [_file_of_frame(element, hr_path) for element in value]
    name, layer = split_exr(value.removeprefix("file:"))
    if not value.startswith("file:") or not name or Path(name).is_dir() or not is_sequence(Path(name)):
        return value
    numbered = frame_in_name(hr_path)
    if numbered is None:
        raise InputError(f"{name}: is a pattern, but {hr_path} has no frame number in its name; name one file")
    return f"file:{parse_pattern(Path(name)).path(numbered[1])}" + (f":{layer}" if layer else "")


class MappedPair(NamedTuple):
    """Both renders of a frame, mapped for one view or view layer."""

    lr: MappedRender
    hr: MappedRender


def map_pair(lr_path: str | Path, hr_path: str | Path, inputs: InputOptions) -> MappedPair:
    """Open both files and map their layers to features.

    Returns:
        LRHS and HRLS. The LRHS has albedo and normal only if its file does. It is mapped for the view of the HRLS, or
        for its own first view if it lacks that one. One render, whose path is given as both, is both.
    """
    lr_path, hr_path = Path(lr_path), Path(hr_path)
    if lr_path == hr_path:
        render = map_hrls(open_exr(hr_path), inputs)
        render.space = _common_space(render, render, inputs.colourspace)
        return MappedPair(render, render)
    check_two_files(lr_path, hr_path)
    lr_file, hr_file = open_exr(lr_path), open_exr(hr_path)
    lr, hr = _map_lrhs(lr_file, inputs), map_hrls(hr_file, inputs)
    if hr.view in lr.other_views:
        lr = _map_lrhs(lr_file, replace(inputs, view=hr.view))
    elif lr.view in hr.other_views:
        raise InputError(
            f"{lr_path}: has no view or view layer {hr.view!r}, which would be fused of {hr_path}; "
            f"choose one that both have with --view-layer, such as {lr.view!r}"
        )
    lr.space = hr.space = _common_space(lr, hr, inputs.colourspace)
    return MappedPair(lr, hr)


def both_paths(lr_path: str | Path | None, hr_path: str | Path) -> tuple[Path, Path]:
    """Return the paths of the LRHS and of the HRLS, which may not be one file; that of the only render as both."""
    if lr_path is not None:
        check_two_files(Path(lr_path), Path(hr_path))
    return Path(hr_path if lr_path is None else lr_path), Path(hr_path)


def check_two_files(lr_path: Path, hr_path: Path) -> None:
    """Raise InputError if two paths are the same file."""
    if lr_path.exists() and hr_path.exists() and lr_path.samefile(hr_path):
        raise InputError(f"{lr_path}: given twice; give it alone, or two renders with a noise seed of their own")


def _map_other_view(lr: MappedRender, hr: MappedRender, view: str, inputs: InputOptions) -> MappedPair:
    """Map a pair, which is mapped for its first view, for one of ``hr.other_views``."""
    high = map_other_hrls(hr, view, inputs)
    if lr is hr:
        high.space = hr.space
        return MappedPair(high, high)
    low = _map_lrhs(lr.file, replace(inputs, view=view))
    if low.view != view:
        raise InputError(f"{lr.name}: has no view or view layer {view!r}")
    low.space = high.space = hr.space
    return MappedPair(low, high)


def map_other_hrls(hr: MappedRender, view: str, inputs: InputOptions) -> MappedRender:
    """Map the HRLS for another view. An entry that means a layer of the first view by its full name does not apply.

    Raises:
        InputError: the file has no such view, or can't be used for it.
    """
    inputs = replace(inputs, view=view)
    try:
        render = _map_hrls(hr.file, inputs)
    except InputError:
        inputs = replace(inputs, sums=())  # the other views need not have the layers of the user's sums
        render = _map_hrls(hr.file, inputs)
    of_first_view = {name for name, formula in render.features.items() if hr.features.get(name) == formula}
    return _without_entries(render, inputs, of_first_view | _features_of_others(render))


def find_views(
    lr: MappedRender, hr: MappedRender, inputs: InputOptions, write: WriteOptions = WriteOptions()
) -> tuple[list[MappedPair], tuple[str, ...]]:
    """Find the views and view layers to fuse: those whose beauty or passes are written, or the one ``inputs`` names.

    Returns:
        The pair, mapped for each of them, the first one in front as it is given. And why other views are not fused, and
        which beauties are not written, one sentence each.

    Raises:
        InputError: the first view does not fit together, or a pattern of ``write`` matches nothing.
    """
    if inputs.view is not None or not hr.other_views:
        return [MappedPair(lr, hr)], ()
    scale = align(lr, hr).scale
    dropped = dropped_channels(hr.file, hr.beauty_channels, write.layers)
    taken = _channels(hr)
    views, passed_on = [MappedPair(lr, hr)], []
    for label in hr.other_views:
        try:
            view = _map_other_view(lr, hr, label, inputs)
            if (here := align(*view).scale) != scale:
                raise InputError(f"the pair is x{here} here and x{scale} in {hr.view}")
            if not taken.isdisjoint(view.hr.beauty_channels):
                raise InputError("its beauty is a layer of another view")
        except InputError as error:
            passed_on.append(f"{name_of(label)} is passed on as it is: {error}")
            continue
        # A layer of no view layer may be found for several.
        view.hr.additive_sets = [each for each in view.hr.additive_sets if taken.isdisjoint(_channels_of_set(each))]
        made = view.hr.beauty_channels if write.passes == ("none",) else _channels(view.hr)
        if not dropped.issuperset(made):
            taken |= _channels(view.hr)
            views.append(view)
        if dropped.issuperset(view.hr.beauty_channels):
            passed_on.append(f"the beauty of {name_of(label)} is left out, because --layers does not name it")
    return views, tuple(passed_on)


def _channels(hr: MappedRender) -> set[object]:
    """Return the channels that may be fused for a view."""
    return {*hr.beauty_channels}.union(*map(_channels_of_set, hr.additive_sets))


def _channels_of_set(additive_set: AdditiveSet) -> set[object]:
    return {channel for layer in additive_set.layers for channel in layer.channels}


def _common_space(lr: MappedRender, hr: MappedRender, name: str | None) -> ColourSpace:
    """Return the linear RGB space of a pair; ``name`` is :attr:`InputOptions.colourspace`."""
    if name is not None:
        space = named_space(name)
        if space is None:
            raise InputError(f"--colorspace {name!r}: use one of {', '.join(space.name for space in SPACES)}")
        return space
    for render in (lr, hr):
        if encoding := encoding_of(render.metadata):
            raise InputError(
                f"by its header {render.name} is in {encoding}, which is not linear; write it in a linear colour space "
                "(or name the space of both renders with --colorspace if the header is wrong)"
            )
    low, high = space_of(lr.metadata), space_of(hr.metadata)
    if low is not None and high is not None and not same_space(low, high):
        raise InputError(
            f"by their headers {lr.name} is in {low.name} and {hr.name} in {high.name}; write both in the same colour "
            "space (or name it with --colorspace if a header is wrong)"
        )
    return high or low or REC709


def map_hrls(file: ExrFile, inputs: InputOptions) -> MappedRender:
    """Map the HRLS for the view that is asked for, or for its first one.

    If no view is asked for, an entry of the mapping that means a layer of another view layer by its full name does not
    apply. Errors are those of :func:`oiio_msspl.aovs.matching.map_render`.
    """
    render = _map_hrls(file, inputs)
    if inputs.view is None:
        return _without_entries(render, inputs, _features_of_others(render))
    if not render.view:
        raise InputError(
            f"{file.path}: no view or view layer {inputs.view!r}; the file names none, so leave --view-layer out"
        )
    return render


def _map_hrls(file: ExrFile, inputs: InputOptions) -> MappedRender:
    return map_render(file, inputs.mapping_of(file.path), view=inputs.view, spp=inputs.hr_spp, sums=inputs.sums)


def _features_of_others(render: MappedRender) -> set[str]:
    """Name the features that are read from layers of another view layer."""
    names = {channel: layer.name for channel, layer in layer_by_channel(render.file).items()}
    prefix, *prefixes = (f"{label.rpartition('/')[2]}." for label in (render.view, *render.other_views))
    others = tuple(name for name in prefixes if name not in (prefix, "."))
    return {
        feature
        for feature, formula in render.features.items()
        if feature != RGB and all(names.get(channel, "").startswith(others) for channel in formula.channels)
    }


def _without_entries(render: MappedRender, inputs: InputOptions, features: set[str]) -> MappedRender:
    """Map a render again without the user's entries for some features, if there are any."""
    if features.isdisjoint(inputs.mapping):
        return render
    mapping = {name: layer for name, layer in inputs.mapping.items() if name not in features}
    return _map_hrls(render.file, replace(inputs, mapping=mapping))


def _map_lrhs(file: ExrFile, inputs: InputOptions) -> MappedRender:
    """Map the beauty of the LRHS, and albedo and normal where it has them."""
    # The user's mapping is written for the HRLS, and only its entry for the beauty applies here: the LRHS need not have
    # the other layers, and an entry may name an EXR of the HRLS's size. Nor need it have the layers of the user's sums.
    features = [name for name in (ALBEDO, NORMAL) if name not in inputs.mapping]
    mapping = {name: layer for name, layer in inputs.mapping.items() if name == RGB}
    mapped = partial(map_render, file, mapping, view=inputs.view, spp=inputs.lr_spp, features=features)
    with contextlib.suppress(InputError):
        return mapped(sums=inputs.sums)
    return mapped()


def files_by_name(renders: Sequence[Path], inputs: InputOptions, model: str | None) -> list[Path]:
    """Return the files that a frame is made from, without opening any. Those of the mapping need not exist.

    The first ones are ``renders``: the frame's pair, and the pairs of neighbours that it depends on.
    """
    return [*renders, *sorted(inputs.files(renders[1], model).union(*map(aov_files, renders)))]
