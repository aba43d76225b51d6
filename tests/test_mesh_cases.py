"""Every row of the table of mesh files: size and mass of what comes out, or the line that refuses it."""

import numpy as np
import pytest
from mesh_cases import CASES, write_case

from pregrasp_jax.assets.bank import make_bank
from pregrasp_jax.assets.mesh_file import load_mesh
from pregrasp_jax.assets.meshes import make_object
from pregrasp_jax.assets.settings import ObjectSettings


@pytest.mark.parametrize("name", CASES)
def test_what_comes_out_of_a_mesh_file(tmp_path, name):
    case = CASES[name]()
    path = write_case(tmp_path, case)
    if case.size is None:
        with pytest.raises(ValueError) as error:
            load_mesh(path, ObjectSettings())
        assert case.said in str(error.value)
        assert "\n" not in str(error.value)
        return
    mesh = load_mesh(path, ObjectSettings())
    np.testing.assert_allclose(mesh.extents * 1e3, case.size, atol=0.02)
    assert mesh.volume * 300 == pytest.approx(case.mass, rel=1e-3)
    assert mesh.is_watertight or not case.whole
    assert (case.said in mesh.metadata["doubt"]) and bool(case.said) == bool(mesh.metadata["doubt"])


@pytest.mark.parametrize(("name", "hulls"), [("obj relative", 2), ("obj polygon from 2", 3), ("glb y up", 1)])
def test_hulls_of_a_mesh_file_weigh_what_it_does(tmp_path, name, hulls):
    """Foot and post are two, and a U profile is three, whatever the corner that its caps begin with."""
    case = CASES[name]()
    made = make_object("m", write_case(tmp_path, case), ObjectSettings())
    bank = make_bank([made.item])
    assert int((np.asarray(bank.object_hulls) >= 0).sum()) == hulls
    assert float(bank.mass[0]) == pytest.approx(case.mass, rel=0.05)
    assert made.fit.is_good and (case.said in made.doubt)
