# SPDX-License-Identifier: Apache-2.0
"""How pixels move from one frame to another: vectors, camera, optical flow."""
