# SPDX-License-Identifier: Apache-2.0
"""Which additive sets of a frame are fused, and which of their layers: decided by names, and by the renders' pixels."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from oiio_msspl.aovs.additive_sets import AdditiveLayer, AdditiveSet
from oiio_msspl.aovs.features import LIGHT_OF
from oiio_msspl.aovs.mapped_render import MappedRender
from oiio_msspl.exr.reader import Channel
from oiio_msspl.fusion.passes.sums import check_sum, is_sum_of
from oiio_msspl.image.parallel import in_parallel

#: Layers, each with the layers that it is the sum of.
Sums = dict[AdditiveLayer, tuple[AdditiveLayer, ...]]


@dataclass(frozen=True)
class PassJob:
    """A set that sums to the beauty."""

    layers: AdditiveSet
    keys: dict[AdditiveLayer, str]
    """Names, as features, of the light of the layers."""
    lrhs: dict[str, AdditiveLayer]
    """The same layers in the LRHS, as far as it has them, by these names."""
    lacking: float
    """Share of the beauty's light that is in no layer; 0 if only rounding is lacking."""
    known: Sums
    """Layers of this set that are sums of layers of an earlier set, or that both sets have. The other layers are
    fitted, and share what these leave of the beauty."""
    noise_free: frozenset[AdditiveLayer] = frozenset()
    """See :attr:`oiio_msspl.fusion.passes.sums.SumCheck.noise_free`."""
    coarser: Sums = field(default_factory=dict)
    """Layers outside of all sets that are sums of layers of this one."""

    @property
    def remainder(self) -> bool:
        """Some light is in no layer."""
        return self.lacking > 0

    @property
    def fitted(self) -> list[AdditiveLayer]:
        return [layer for layer in self.layers.layers if layer not in self.known]

    def lit(self, names: Collection[str]) -> dict[AdditiveLayer, str]:
        """The fitted layers whose light is among the ``names`` of features, and these names."""
        return {layer: self.keys[layer] for layer in self.fitted if self.keys[layer] in names}

    @property
    def hrls_alone(self) -> str:
        """Names of fitted layers that the LRHS lacks, or "all layers" if it has none; empty if it lacks none."""
        missing = [layer.name for layer in self.fitted if self.keys[layer] not in self.lrhs]
        return "all layers" if missing and not self.lrhs else ", ".join(missing)

    @property
    def channels(self) -> list[Channel]:
        """What is written."""
        return [channel for layer in (*self.layers.layers, *self.coarser) for channel in layer.channels]


def plan_passes(
    lr: MappedRender, hr: MappedRender, sets: Sequence[AdditiveSet]
) -> tuple[list[PassJob], dict[str, str], list[str]]:
    """The sets that sum to the beauty; why each of the others does not, by name; and warnings of layers of the LRHS.

    Sets with more layers come first, because layers of the others may be sums of theirs.
    """
    jobs: list[PassJob] = []
    refused: dict[str, str] = {}
    warnings: list[str] = []
    names = _layer_names(sets)
    for layers in sorted(sets, key=lambda each: -len(each.layers)):
        check, (lrhs, problem) = in_parallel(partial(check_sum, hr, layers), partial(_usable_layers, lr, layers))
        if check.problem:
            refused[layers.name] = check.text
            continue
        # All known layers come from one set. Those of two sets could have more light than the beauty.
        known = max((_sums_of(hr, layers.layers, job.layers) for job in jobs), key=len, default={})
        taken = {channel for job in jobs for channel in job.channels}
        shared = [each.name for each in layers.layers if each not in known and not taken.isdisjoint(each.channels)]
        if shared:
            refused[layers.name] = f"shares {shared[0]} with another set that does not have its other layers"
            continue
        keys = {layer: names[layer] for layer in layers.layers}
        theirs = {key: lrhs[layer] for layer, key in keys.items() if layer in lrhs}
        job = PassJob(layers, keys, theirs, check.residual if check.remainder else 0.0, known, check.noise_free)
        jobs.append(job)
        if problem:
            warnings.append(
                f"{layers.name}: the LRHS's layers do not sum to its beauty, so they are not read: {problem}"
            )
        elif theirs and job.hrls_alone:
            warnings.append(f"{layers.name}: the LRHS lacks {job.hrls_alone}, so more noise is left there")
    taken = {channel for job in jobs for channel in job.channels}
    for job in jobs:
        for layer in job.layers.coarser:
            if taken.isdisjoint(layer.channels):
                job.coarser.update(_sums_of(hr, [layer], job.layers))
    return jobs, refused, warnings


def _sums_of(hr: MappedRender, layers: Sequence[AdditiveLayer], finer: AdditiveSet) -> Sums:
    """Those of some layers that a set has, or that by name and pixels are sums of its layers.

    No layer of the set belongs to two sums.
    """
    sums: Sums = {}
    used: set[AdditiveLayer] = set()
    for layer in layers:
        parts = tuple(each for each in finer.layers if layer.words < each.words) if layer.words else ()
        if layer in finer.layers:
            parts = (layer,)
        elif layer.factor is not None or len(parts) < 2 or not is_sum_of(hr, layer, parts):
            continue
        if used.isdisjoint(parts):
            sums[layer] = parts
            used.update(parts)
    return sums


def _usable_layers(lr: MappedRender, layers: AdditiveSet) -> tuple[dict[AdditiveLayer, AdditiveLayer], str]:
    """The layers of :func:`_same_layers`; and why they can't be used, if they do not sum to the LRHS's beauty.

    They may lack some of its light.
    """
    found = _same_layers(lr, layers)
    problem = check_sum(lr, AdditiveSet(layers.name, tuple(found.values()))).problem if found else ""
    return ({}, problem) if problem else (found, "")


def _same_layers(render: MappedRender, layers: AdditiveSet) -> dict[AdditiveLayer, AdditiveLayer]:
    """Layers of a set, each with the layer of the same name in another render: in the set that has most of them."""
    by_name = {(layer.name, layer.factor is None): layer for layer in layers.layers}
    found = (
        {by_name[key]: each for each in candidate.layers if (key := (each.name, each.factor is None)) in by_name}
        for candidate in render.additive_sets
    )
    return max(found, key=len, default={})


def pass_features(lr: MappedRender, hr: MappedRender, sets: Sequence[AdditiveSet]) -> tuple[MappedRender, MappedRender]:
    """LRHS and HRLS, with the light of layers of additive sets as further features. The LRHS may lack some of them."""
    names = _layer_names(sets)
    low = {layer: each for additive_set in sets for layer, each in _same_layers(lr, additive_set).items()}
    low_light = {names[layer]: each.formula for layer, each in low.items()}
    high_light = {name: layer.formula for layer, name in names.items()}
    return replace(lr, features=lr.features | low_light), replace(hr, features=hr.features | high_light)


def _layer_names(sets: Sequence[AdditiveSet]) -> dict[AdditiveLayer, str]:
    """Names, as features, of the light of all layers. Frames of a shot have the same names."""
    names: dict[AdditiveLayer, str] = {}
    for layer in dict.fromkeys(layer for each in sets for layer in each.layers):
        name = f"{LIGHT_OF}{layer.name}{' x colour' if layer.factor else ''}"
        while name in names.values():
            name += " again"
        names[layer] = name
    return names
