# SPDX-License-Identifier: Apache-2.0
"""Words messages for the command line, or for Python. They are written with the options of the command line."""

from __future__ import annotations

import re

#: True in the programs: messages name their options. False in Python: messages name its arguments.
for_command_line = False

#: Arguments that are not called as their option.
_ARGUMENTS = {
    "map": "mapping",
    "sum": "sums",
    "colorspace": "colourspace",
    "view-layer": "view",
    "ocio-view": "view_transform",
    "report": "report_path",
    "temporal": "temporal",
    "float": 'pixel_type="float"',
    "quality": "model",
    "scheduler": "client",
    "debug": "its traceback",
}
#: Options with a value behind them: ``--map albedo=LAYER``, ``--model NAME``.
_MAPPED = re.compile(r"(?<![\w-])--map '?(\w+)=([^\s,;)']+)'?")
_WITH_VALUE = re.compile(r"(?<![\w-])--(model|quality|device|layout|motion-format) ([a-z][\w=,.|-]*\w)")
_OPTION = re.compile(r"(?<![\w-])--([a-z][a-z-]*)")


def worded(text: str) -> str:
    """Return a message for whoever reads it: with options in the programs, with arguments in Python."""
    if for_command_line:
        return text
    text = _MAPPED.sub(r'mapping={"\1": "\2"}', text)
    text = _WITH_VALUE.sub(lambda match: f'{_argument(match[1])}="{match[2]}"', text)
    return _OPTION.sub(lambda match: _argument(match[1]), text)


def _argument(option: str) -> str:
    return _ARGUMENTS.get(option, option.replace("-", "_"))
