"""What the pages of docs/ state about limits is what the code allows."""

from pathlib import Path

from pregrasp_jax.assets import formats, mesh_file

DOCS = Path(__file__).parent.parent / "docs"


def test_the_limits_of_a_mesh_are_those_of_the_code() -> None:
    text = " ".join((DOCS / "meshes.md").read_text().split())
    height = f"{mesh_file.MIN_OBJECT_HEIGHT:.2f} to {mesh_file.MAX_OBJECT_HEIGHT:.2f} m tall"
    width = f"at most {mesh_file.MAX_OBJECT_WIDTH:g} m wide"
    thickness, size = f"at least {1e3 * mesh_file.MIN_OBJECT_WIDTH:g} mm thick", f"{formats.MAX_BYTES >> 20} MB"
    assert [limit for limit in (height, width, thickness, size) if limit not in text] == []
