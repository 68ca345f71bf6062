# SPDX-License-Identifier: Apache-2.0
"""Which additive sets of a frame are fused, and which of their layers: decided by names, and by the renders' pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from oiio_msspl.aovs.additive_sets import AdditiveLayer, AdditiveSet
from oiio_msspl.exr.reader import Channel
from oiio_msspl.findings import Finding
from oiio_msspl.fusion.passes.layers import LayerLight, same_layers
from oiio_msspl.fusion.passes.sums import check_light
from oiio_msspl.image.parallel import in_parallel

#: Layers, each with the layers that it is the sum of.
Sums = dict[AdditiveLayer, tuple[AdditiveLayer, ...]]


@dataclass(frozen=True)
class PassJob:
    """A set that sums to the beauty."""

    layers: AdditiveSet
    names: dict[AdditiveLayer, str]
    """Names, as features, of the light of the layers."""
    lrhs: frozenset[str]
    """Those of these names that the LRHS has, too."""
    lacking: float
    """Share of the beauty's light that is in no layer; 0 if only rounding is lacking."""
    derived: Sums
    """Layers of this set that are sums of layers of an earlier set, or that both sets have."""
    noise_free: frozenset[AdditiveLayer] = frozenset()
    """See :attr:`oiio_msspl.fusion.passes.sums.SumCheck.noise_free`."""
    coarser: Sums = field(default_factory=dict)
    """Layers outside of all sets that are sums of layers of this one."""

    @property
    def remainder(self) -> bool:
        """Whether some light is in no layer."""
        return self.lacking > 0

    @property
    def estimated(self) -> list[AdditiveLayer]:
        """The layers that are not derived. They share what the derived ones leave of the beauty."""
        return [layer for layer in self.layers.layers if layer not in self.derived]

    @property
    def hrls_alone(self) -> str:
        """Names of estimated layers that the LRHS lacks, or "all layers" if it has none; empty if it lacks none."""
        missing = [layer.name for layer in self.estimated if self.names[layer] not in self.lrhs]
        return "all layers" if missing and not self.lrhs else ", ".join(missing)

    @property
    def written(self) -> AdditiveSet:
        """The set, with the coarser layers that are sums of its layers."""
        return replace(self.layers, coarser=tuple(self.coarser))

    @property
    def channels(self) -> list[Channel]:
        """The channels that are written."""
        return [channel for layer in (*self.layers.layers, *self.coarser) for channel in layer.channels]


def plan_passes(
    low: LayerLight, high: LayerLight, sets: Sequence[AdditiveSet]
) -> tuple[list[PassJob], dict[str, str], list[Finding]]:
    """Find the sets of the HRLS that sum to its beauty, given the light of all their layers in either render.

    Returns:
        Those sets: ones with more layers come first, because layers of the others may be sums of theirs. Why others
        are not fused, by name. And a sentence for each set whose layers the LRHS lacks, or do not sum to its beauty.
    """
    jobs: list[PassJob] = []
    refused: dict[str, str] = {}
    warnings: list[Finding] = []
    for layers in sorted(sets, key=lambda additive_set: -len(additive_set.layers)):
        check, (lrhs, problem) = in_parallel(
            partial(check_light, high, layers), partial(_usable_layers, low, high, layers)
        )
        if check.problem:
            refused[layers.name] = check.text
            continue
        # All derived layers come from one set. Those of two sets could have more light than the beauty.
        derived = max((_sums_of(high, layers.layers, job.layers) for job in jobs), key=len, default={})
        taken = {channel for job in jobs for channel in job.channels}
        shared = [x.name for x in layers.layers if x not in derived and not taken.isdisjoint(x.channels)]
        if shared:
            refused[layers.name] = f"shares {shared[0]} with another set that does not have its other layers"
            continue
        names = {layer: high.names[layer] for layer in layers.layers}
        job = PassJob(layers, names, lrhs, check.residual if check.remainder else 0.0, derived, check.noise_free)
        jobs.append(job)
        if problem:
            text = f"{layers.name}: the LRHS's layers do not sum to its beauty, so they are not read: {problem}"
            warnings.append(Finding("passes", text))
        elif lrhs and job.hrls_alone:
            text = f"{layers.name}: the LRHS lacks {job.hrls_alone}, so more noise is left there"
            warnings.append(Finding("passes", text))
    taken = {channel for job in jobs for channel in job.channels}
    for job in jobs:
        for layer in job.layers.coarser:
            if taken.isdisjoint(layer.channels):
                job.coarser.update(_sums_of(high, [layer], job.layers))
    return jobs, refused, warnings


def _sums_of(high: LayerLight, layers: Sequence[AdditiveLayer], finer: AdditiveSet) -> Sums:
    """Return those layers that a set has, or that are sums of its layers by name and pixels. No two share one."""
    sums: Sums = {}
    used: set[AdditiveLayer] = set()
    for layer in layers:
        parts = tuple(part for part in finer.layers if layer.words < part.words) if layer.words else ()
        if layer in finer.layers:
            parts = (layer,)
        elif layer.factor is not None or len(parts) < 2:
            continue
        else:
            check = check_light(high, AdditiveSet(layer.name, parts), layer)
            if check.problem or check.remainder:
                continue
        if used.isdisjoint(parts):
            sums[layer] = parts
            used.update(parts)
    return sums


def _usable_layers(low: LayerLight, high: LayerLight, layers: AdditiveSet) -> tuple[frozenset[str], str]:
    """Return names of the layers that the LRHS has; and why they can't be used, if they are no part of its beauty."""
    matches = same_layers(low.file, layers)
    problem = check_light(low, AdditiveSet(layers.name, tuple(matches.values()))).problem if matches else ""
    return (frozenset(), problem) if problem else (frozenset(high.names[layer] for layer in matches), "")
