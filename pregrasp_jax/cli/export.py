"""`pregrasp-jax export`, `verify`, `contract`: a policy as a bundle, and whether a bundle is whole."""

from pathlib import Path
from typing import Literal

from pregrasp_jax.deploy.bundle import read_bundle
from pregrasp_jax.deploy.contract import format_contract

Format = Literal["safetensors", "onnx", "stablehlo"]


def export(
    policy: str,
    out: Path,
    /,
    *,
    formats: tuple[Format, ...] = ("safetensors", "onnx", "stablehlo"),
    golden: int = 8,
    force: bool = False,
) -> None:
    """Write a policy as a bundle that runs without JAX and says what every number means (extra `export`).

    Args:
        policy: pretrained, a run folder, or a policy's folder or file.
        out: Folder of the bundle.
        formats: What to write the policy as.
        golden: States with right answers, for `verify`.
        force: Replace a bundle that is there.
    """
    import pregrasp_jax.startup as startup
    from pregrasp_jax.checkpoint import load_policy

    try:
        from pregrasp_jax.export.bundle import export_policy
    except ImportError as error:
        raise ValueError(f"{error.name} is not installed; allowed is pip install 'pregrasp_jax[export]'") from None
    startup.prepare()
    contract = export_policy(load_policy(policy), out, formats=formats, golden=golden, force=force)
    for name, entry in contract.files.items():
        print(f"{name:<24}{entry.bytes / 1e3:9.1f} kB")
    print(f"wrote {out}: {sum(entry.bytes for entry in contract.files.values()) / 1e6:.1f} MB; README.md explains it")


def verify(bundle: Path, /, *, formats: tuple[str, ...] = (), tolerance: float = 1e-4) -> int:
    """Compare every file of a bundle with its golden answers. Exit code 0: all pass, 1: one fails, 2: not whole.

    Args:
        bundle: Folder that `export` has written.
        formats: Only these (onnx, safetensors, stablehlo, stablehlo_batch); all that there are if left out.
        tolerance: Largest difference of a value.
    """
    from pregrasp_jax.export.verify import verify as find

    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance = {tolerance} is out of range; allowed is above 0 to 1")
    findings = find(read_bundle(bundle), formats=formats, tolerance=tolerance)
    for finding in findings:
        print(finding.line())
    if all(finding.passed is None for finding in findings if finding.name != "heightmaps"):
        print("nothing could be checked here")
        return 1
    return int(any(finding.passed is False for finding in findings))


def contract(bundle: Path, /) -> None:
    """Print what a bundle says about itself: inputs, outputs, grid, action, end, robot, camera, evaluation.

    Args:
        bundle: Folder that `export` has written.
    """
    print(format_contract(read_bundle(bundle).contract))
