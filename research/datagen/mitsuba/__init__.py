# SPDX-License-Identifier: Apache-2.0
"""Training views rendered with Mitsuba 3 from procedural scenes, see :mod:`research.datagen.views` for the files.

    python -m research.datagen.mitsuba --out VIEWS --seeds 0:400

``start`` imports Mitsuba. ``scenes`` builds the scene of a seed from ``materials`` and ``assets``. ``trace`` is a path
tracer that returns every sample on its own. ``render`` chooses cameras and renders views.
"""
