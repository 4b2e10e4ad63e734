"""Benchmarks of stock media, on small pictures, and their tables."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import media, record, tables

SCENE = """<scene version="3.0.0"><default name="res" value="8"/><default name="spp" value="1"/>
<default name="integrator" value="path"/>
<integrator type="moment"><integrator type="$integrator"><integer name="max_depth" value="2"/></integrator></integrator>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/>
<rfilter type="box"/></film><sampler type="independent"><integer name="sample_count" value="$spp"/></sampler></sensor>
<emitter type="constant"/>
<shape type="sphere"><bsdf type="null"/><medium type="homogeneous" name="interior"><float name="scale" value="1"/>
</medium></shape></scene>"""


def test_a_scene_of_media_passes_its_z_test(tmp_path, monkeypatch):
    """A ball of fog equals ``volpath`` by each method, and a table shows the rows."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("MI_NTF_CACHE", "memory")
    record.prepare("memory")
    path = tmp_path / "test_fog.xml"
    path.write_text(SCENE)
    assert media.names(tmp_path) == ["test_fog"] and media.depth_of(media.scene(path, 8)) == 2
    rows = media.rows(path, 8, 4, 64, 256)
    assert len(rows) == 3 and all(row["passes"] and abs(row["ratio"] - 1) < 0.05 for row in rows)
    assert "| fog | 2 |" in tables.media({"rows": rows})


def test_a_wrong_picture_fails_the_z_test():
    """Pictures that are 3 % too bright fail at a standard error of 0.3 %."""
    rng = np.random.default_rng(4)
    pictures = [level * rng.normal(1, 0.2, (8, 32, 32, 3)) for level in (1.0, 1.0, 1.03)]
    assert media.compared(pictures[0], pictures[1])["passes"]
    assert not media.compared(pictures[2], pictures[1])["passes"]


@pytest.mark.slow  # a minute
def test_smoke_end_to_end(tmp_path):
    """The quick run writes rows of both lights, which the table shows."""
    done = subprocess.run([sys.executable, "-m", "benchmarks.smoke", "--quick", "--out", str(tmp_path)],
                          capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    values = json.loads(Path(tmp_path, "smoke.json").read_text())["values"]
    assert {row["light"] for row in values["rows"]} == {"lamp", "environment"}
    assert "`raymarch`" in tables.smoke(values)
