# SPDX-License-Identifier: GPL-3.0-or-later
"""What msspl-render starts: ``blender -b scene.blend --python headless.py -- job.json``.

Or ``python -P headless.py job.json`` with a Python that has bpy.

The job is a JSON object: ``scene``, ``frames`` (a list of [number or null, file to write]), ``program`` (msspl-fuse),
``work`` (a folder on the file system of the results), ``options`` (fields of :class:`render.Options`), ``overwrite``,
``keep``, ``compare``. What happens is printed as lines of ``MSSPL`` and a JSON object.
"""

import importlib
import json
import os
import shutil
import sys
import time
import traceback
from dataclasses import asdict
from pathlib import Path

import bpy

_FOLDER = Path(__file__).resolve().parent
sys.path.append(str(_FOLDER.parent))
frame = importlib.import_module(f"{_FOLDER.name}.frame")
render = importlib.import_module(f"{_FOLDER.name}.render")
Failure = importlib.import_module(f"{_FOLDER.name}.errors").Failure


def tell(**what):
    print("MSSPL", json.dumps(what), flush=True)


def main(job):
    """Fuse every frame of a job.

    Raises:
        Failure: the sentence says why; frames before it are complete.
    """
    if bpy.app.version < (4, 5, 0):
        raise Failure(f"Blender {bpy.app.version_string} is too old; use 4.5 or later")
    if not bpy.data.filepath:
        try:
            bpy.ops.wm.open_mainfile(filepath=job["scene"])
        except RuntimeError as error:
            raise Failure(f"{job['scene']}: can't be opened ({str(error).strip()})") from error
    scene, options = bpy.context.scene, render.Options(**job["options"])
    for number, output in job["frames"]:
        if number is not None:
            scene.frame_set(number)
        _frame(scene, options, job, scene.frame_current, Path(output))


def _frame(scene, options, job, number, output):
    def told(step, fraction):
        tell(frame=number, step=step, fraction=fraction)

    told("start", 0.0)
    steps = frame.make(scene, options, output, job["work"], job["program"], overwrite=job["overwrite"])
    report = frame.finish(steps, told)
    result = {"frame": number, "seconds": report.seconds, "plain_spp": report.plain_spp, **asdict(report)}
    for take, suffix in ((report.lrhs, "lr"), (report.hrls, "hr")):
        file = beside(output, suffix)
        if job["keep"]:
            os.replace(take.file, file)
        else:
            os.unlink(take.file)
        result[take.name.lower()]["file"] = str(file) if job["keep"] else None
    if job["compare"]:
        result["oidn"] = _same_time(scene, options, report, told, Path(job["work"]))
        os.replace(result["oidn"]["file"], beside(output, "oidn"))
        result["oidn"]["file"] = str(beside(output, "oidn"))
    tell(report=result)


def beside(output, suffix):
    return output.with_name(f"{output.stem}_{suffix}.exr")


def _same_time(scene, options, report, told, work):
    """Render the frame in the ordinary way, denoised with OIDN, in the time that LRHS, HRLS and fusion took.

    How many samples that is, is known only from trying: each try is corrected by its own time, and the closest of three
    is kept.
    """
    tries, samples = {}, report.plain_spp
    while len(tries) < 3 and (spp := max(1, round(samples))) not in tries:
        told(f"plain rendering and OIDN, {spp} spp", 1.0)
        start = time.perf_counter()
        file = work / f"oidn{spp}.exr"
        values = render.plain(scene, options, spp)
        with render.settings(scene, values | {"render.filepath": render.literal(str(file))}):
            render.check_animation(scene, values)
            list(render.render(scene, str(file)))
        tries[spp] = {"spp": spp, "seconds": time.perf_counter() - start, "file": str(file)}
        ratio = report.seconds / tries[spp]["seconds"]
        if 0.9 < ratio < 1.1:
            break
        samples = spp * ratio
    return min(tries.values(), key=lambda each: abs(each["seconds"] - report.seconds))


def leave(code):
    sys.stdout.flush()
    if bpy.app.binary_path:
        sys.exit(code)
    # Python's own exit would run the destructors of bpy, and those of 4.5 can wait for ever.
    shutil.rmtree(bpy.app.tempdir, ignore_errors=True)
    os._exit(code)


if __name__ == "__main__":
    try:
        main(json.loads(Path(sys.argv[-1]).read_text(encoding="utf-8")))
    except Failure as error:
        tell(error=str(error), code=error.code)
        leave(error.code)
    except Exception as error:  # Blender itself would print it and go on to end well
        traceback.print_exc(file=sys.stdout)
        tell(error=f"unexpected {type(error).__name__} in Blender: {error} (-v shows where)", code=1)
        leave(1)
    leave(0)
