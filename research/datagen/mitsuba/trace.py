# SPDX-License-Identifier: Apache-2.0
"""Path tracing without a film: every sample of every pixel is returned on its own.

One wavefront holds `spp` independent passes, so eight 1-spp renders cost one kernel launch, and a non-finite
sample can be dropped by itself instead of poisoning its pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

MAX_DEPTH = 10
RR_DEPTH = 4

PixelFilter = Callable[[mi.Float], mi.Float]
"""Maps a uniform random number to a sample's position in its pixel: 0 is the left or top edge, 1 the other one."""


def box(uniform: mi.Float) -> mi.Float:
    """Box filter of one pixel: samples are uniform in their pixel."""
    return uniform


def blackman_harris(width: float = 1.5, size: int = 1024) -> PixelFilter:
    """Blackman-Harris filter, importance-sampled by the inverse of its integral.

    It is sampled, as Cycles does, so that pixels share no noise.
    """
    t = np.linspace(0, 1, 16 * size)
    a = (0.35875, -0.48829, 0.14128, -0.01168)
    window = sum(value * np.cos(2 * np.pi * k * t) for k, value in enumerate(a))
    integral = np.cumsum(window) / np.sum(window)
    table = mi.Float(0.5 + width * (np.interp(np.linspace(0, 1, size), integral, t) - 0.5))

    def inverse(uniform: mi.Float) -> mi.Float:
        position = uniform * (size - 1)
        index = dr.minimum(mi.UInt32(position), size - 2)
        low, high = (dr.gather(mi.Float, table, index + i) for i in range(2))
        return low + (high - low) * (position - mi.Float(index))

    return inverse


@dataclass(frozen=True)
class Camera:
    """A thin-lens camera; z is up, lengths in metres, `fov` in degrees (the image is square)."""

    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float
    aperture: float = 0.0
    focus: float = 1.0
    roll: float = 0.0

    def rays(self, x: mi.Float, y: mi.Float, lens: mi.Point2f) -> mi.Ray3f:
        """Rays through the image positions x, y in [0, 1], y downwards."""
        forward = np.subtract(self.target, self.origin)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right = right / max(np.linalg.norm(right), 1e-6)
        up = np.cross(right, forward)
        c, s = np.cos(self.roll), np.sin(self.roll)
        right, up = c * right + s * up, c * up - s * right
        half = np.tan(np.radians(self.fov) / 2)

        # Opaque, not literal: a literal would give every camera a kernel of its own to compile.
        def opaque(v: np.ndarray) -> mi.Vector3f:
            return mi.Vector3f(*(dr.opaque(mi.Float, float(a)) for a in v))

        forward_o, right_o, up_o = opaque(forward), opaque(right * half), opaque(up * half)
        focus, aperture = dr.opaque(mi.Float, self.focus), dr.opaque(mi.Float, self.aperture)
        towards = forward_o + right_o * (2 * x - 1) + up_o * (1 - 2 * y)
        disk = mi.warp.square_to_uniform_disk_concentric(lens) * aperture
        shift = dr.normalize(right_o) * disk.x + dr.normalize(up_o) * disk.y
        return mi.Ray3f(o=opaque(np.asarray(self.origin)) + shift, d=dr.normalize(towards * focus - shift))


def _balance(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Return the power heuristic of Mitsuba's path integrator."""
    a, b = dr.square(pdf_a), dr.square(pdf_b)
    return dr.detach(dr.select(pdf_a > 0, a / (a + b), 0), True)


def _share(part: mi.Spectrum, whole: mi.Spectrum) -> mi.Spectrum:
    return dr.select(whole > 0, dr.minimum(part / whole, 1), 0)


@dr.syntax
def sample_layers(scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f) -> Any:
    """Trace one path a lane; return colour, albedo, normal, diffuse, specular (five 3-vectors), and the depth.

    The estimator is that of Mitsuba's `path` (next-event estimation and BSDF sampling, power heuristic).
    A path's light is split by the lobe of its *first* scattering event. A direction belongs to several lobes
    at once, so the split is the ratio of the lobes' values there, not the lobe that was drawn: the same
    expectation, less variance. Transmission, directly seen emission and the background are in neither.
    """
    full = mi.BSDFContext()
    only_diffuse = mi.BSDFContext(mi.TransportMode.Radiance, int(mi.BSDFFlags.DiffuseReflection), 0xFFFFFFFF)
    only_glossy = mi.BSDFContext(mi.TransportMode.Radiance, int(mi.BSDFFlags.GlossyReflection), 0xFFFFFFFF)

    # The features of the first hit, as Mitsuba's `aov` integrator defines `albedo` and `sh_normal`.
    first_hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True)
    hit = first_hit.is_valid()
    albedo = first_hit.bsdf().eval_diffuse_reflectance(first_hit, hit) & hit
    normal = first_hit.sh_frame.n & hit
    distance = dr.select(hit, first_hit.t, 0)

    ray = mi.Ray3f(ray)
    color, diffuse, specular = mi.Spectrum(0), mi.Spectrum(0), mi.Spectrum(0)
    throughput, eta = mi.Spectrum(1), mi.Float(1)
    to_diffuse, to_specular = mi.Spectrum(0), mi.Spectrum(0)
    prev_si, prev_pdf, prev_delta = dr.zeros(mi.SurfaceInteraction3f), mi.Float(1), mi.Bool(True)
    depth, active = mi.UInt32(0), mi.Bool(True)

    while active:
        first = depth == 0
        si = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=first)
        bsdf = si.bsdf(ray)

        # Emission met by the BSDF-sampled ray.
        ds = mi.DirectionSample3f(scene, si, prev_si)
        pdf_em = scene.pdf_emitter_direction(prev_si, ds, active & ~prev_delta)
        seen = throughput * _balance(prev_pdf, pdf_em) * ds.emitter.eval(si, active)
        color += seen
        diffuse += to_diffuse * seen
        specular += to_specular * seen

        active_next = active & (depth + 1 < MAX_DEPTH) & si.is_valid()

        # Light sampled directly.
        active_em = active_next & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, weight_em = scene.sample_emitter_direction(si, sampler.next_2d(), True, active_em)
        active_em &= ds.pdf != 0
        wo = si.to_local(ds.d)
        value, pdf = bsdf.eval_pdf(full, si, wo, active_em)
        direct = throughput * weight_em * dr.select(ds.delta, 1, _balance(ds.pdf, pdf))
        at_first = active_em & first
        part_d = bsdf.eval(only_diffuse, si, wo, at_first)
        part_g = bsdf.eval(only_glossy, si, wo, at_first)
        color += direct * value & active_em
        diffuse += direct * dr.select(first, part_d, to_diffuse * value) & active_em
        specular += direct * dr.select(first, part_g, to_specular * value) & active_em

        # The next direction.
        bs, weight = bsdf.sample(full, si, sampler.next_1d(), sampler.next_2d(), active_next)
        whole = weight * bs.pdf
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        smooth = active_next & first & ~delta
        part_d = bsdf.eval(only_diffuse, si, bs.wo, smooth)
        part_g = bsdf.eval(only_glossy, si, bs.wo, smooth)
        mirrored = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaReflection)
        to_diffuse = dr.select(first, dr.select(delta, 0, _share(part_d, whole)), to_diffuse)
        to_specular = dr.select(
            first, dr.select(delta, dr.select(mirrored, mi.Spectrum(1), 0), _share(part_g, whole)), to_specular
        )

        throughput *= weight
        eta *= bs.eta
        prev_si, prev_pdf, prev_delta = dr.detach(si, True), bs.pdf, delta
        ray = si.spawn_ray(si.to_world(bs.wo))

        # Russian roulette.
        largest = dr.max(throughput)
        active_next &= largest != 0
        survive = dr.minimum(largest * dr.square(eta), 0.95)
        roulette = depth + 1 >= RR_DEPTH
        active_next &= ~roulette | (sampler.next_1d() < survive)
        throughput = dr.select(roulette, throughput / survive, throughput)
        depth += 1
        active = active_next

    return color, albedo, normal, diffuse, specular, distance


#: What a sample may hold: its position in the pixel (0 to 1), radiance, first hit, lobes (3 channels each), and the
#: distance of the first hit (1 channel, 0 for the background).
LAYERS = ("color", "albedo", "normal", "diffuse", "specular", "depth")


def render_samples(
    scene: mi.Scene,
    camera: Camera,
    size: int | tuple[int, int],
    spp: int,
    seed: int,
    layers: tuple[str, ...] = LAYERS,
    pixel_filter: PixelFilter = box,
) -> dict[str, np.ndarray]:
    """Render `spp` samples for every pixel, each with its place: float32 (spp, height, width, C) by name.

    The names are `place` (x and y in the pixel, 0 to 1 for a box) and those of `layers`, see `LAYERS`. A `size` is that
    of a square, or width and height. Samples with a non-finite value are zero.
    """
    columns, rows = (size, size) if isinstance(size, int) else size
    pixel = dr.arange(mi.UInt32, columns * rows * spp) % dr.opaque(mi.UInt32, columns * rows)
    wanted = _trace(scene, camera, columns, rows, pixel, seed, layers, pixel_filter)
    dr.eval([channel for channels in wanted.values() for channel in channels])
    out = {name: np.stack([c.numpy() for c in channels], axis=-1) for name, channels in wanted.items()}
    finite = np.logical_and.reduce([np.isfinite(values).all(axis=-1) for values in out.values()])
    for name in layers:
        out[name][~finite] = 0
    return {name: values.reshape(spp, rows, columns, -1) for name, values in out.items()}


def render_sum(
    scene: mi.Scene, camera: Camera, size: int, spp: int, seed: int, layers: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Sum `spp` samples of every pixel on the device: float32 (size, size, C) by name, see `LAYERS`.

    Samples with a non-finite value count as zero.
    """
    pixel = dr.arange(mi.UInt32, size * size * spp) // dr.opaque(mi.UInt32, spp)
    traced = _trace(scene, camera, size, size, pixel, seed, layers, box)
    channels = [channel for name in layers for channel in traced[name]]
    finite = mi.Bool(True)
    for channel in channels:
        finite &= dr.isfinite(channel)
    sums = [dr.block_sum(dr.select(finite, channel, 0), spp) for channel in channels]
    dr.eval(sums)
    images = iter(plane.numpy().reshape(size, size) for plane in sums)
    return {name: np.stack([next(images) for _ in traced[name]], axis=-1) for name in layers}


def _trace(
    scene: mi.Scene, camera: Camera, columns: int, rows: int, pixel: mi.UInt32, seed: int,
    layers: tuple[str, ...], pixel_filter: PixelFilter,
) -> dict[str, list[mi.Float]]:  # fmt: skip
    """Trace one sample of each of these pixels, not evaluated yet: its channels by name, see :func:`render_samples`."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, len(pixel))
    width, height = (dr.opaque(mi.UInt32, v) for v in (columns, rows))
    row = pixel // width
    jitter, lens = sampler.next_2d(), sampler.next_2d()
    place = [pixel_filter(jitter.x), pixel_filter(jitter.y)]
    x = (mi.Float(pixel - row * width) + place[0]) / mi.Float(width)
    y = (mi.Float(row) + place[1]) / mi.Float(height)
    ray = camera.rays(x, y, lens)
    *vectors, distance = sample_layers(scene, sampler, ray)
    traced = dict(zip(LAYERS, [*map(list, vectors), [distance]], strict=True))
    return {"place": place} | {name: traced[name] for name in layers}


def render_passes(scene: mi.Scene, camera: Camera, size: int, spp: int, seed: int, layers: bool = True) -> np.ndarray:
    """Render `spp` independent 1-spp passes: float32 (spp, height, width, C), as `render_samples` without places.

    C is 15 with `layers` (colour, albedo, normal, diffuse, specular), 3 without.
    """
    names = LAYERS[:5] if layers else LAYERS[:1]
    samples = render_samples(scene, camera, size, spp, seed, names)
    return np.concatenate([samples[name] for name in names], axis=-1)
