# SPDX-License-Identifier: Apache-2.0
"""Puts the pages of the repository's root into the site, and adapts the links between them and ``docs``.

On the site, the folder ``docs`` is the root, and README.md is the home page.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
#: Page of the root -> page of the site.
PAGES = {name: name for name in ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")} | {"README.md": "index.md"}


def on_files(files: Files, config: Any) -> Files:
    """Add the pages of the root."""
    for source, target in PAGES.items():
        files.append(File.generated(config, target, content=(ROOT / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links lead to the pages of the site. A link to another file of the repository becomes plain text."""
    name = page.file.src_uri
    sources = {target: source for source, target in PAGES.items()}
    folder = (ROOT / sources[name] if name in sources else ROOT / "docs" / name).parent

    def adapted(match: re.Match[str]) -> str:
        text, path, anchor = match.groups()
        target = Path(os.path.normpath(folder / path)).relative_to(ROOT).as_posix()
        if target in PAGES:
            target = f"docs/{PAGES[target]}"
        if not target.startswith("docs/") or target == "docs":
            return text.lstrip("!").strip("[]")
        relative = os.path.relpath(target.removeprefix("docs/"), os.path.dirname(name) or ".")
        return f"{text}({Path(relative).as_posix()}{anchor or ''})"

    return re.sub(r"(!?\[[^\]]*\])\((?!https?:|#)([^)#\s]+)(#[^)\s]*)?\)", adapted, markdown)
