"""Every row of the table of mesh files: size and mass of what comes out, or the line that refuses it."""

import numpy as np
import pytest
from mesh_cases import CASES, write_case

from pregrasp_jax.assets.mesh_file import load_mesh
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
