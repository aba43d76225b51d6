"""Read a bundle: every file is what the contract says, byte by byte, before anything of it is used."""

import hashlib
import io as bytes_io
import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pregrasp_jax.deploy.contract import CONTRACT, FORMAT, Contract
from pregrasp_jax.messages import one_line
from pregrasp_jax.settings import from_dict

_WANTED = "allowed is a folder that `pregrasp-jax export` has written"


@dataclass(frozen=True)
class Bundle:
    """A bundle whose files are whole.

    Attributes:
        folder: where it lies.
        contract: what it says.
        files: name -> content.
    """

    folder: Path
    contract: Contract
    files: dict[str, bytes]

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        """Return the arrays of an npz of the bundle.

        Raises:
            ValueError: the bundle has no such file, or it cannot be read.
        """
        if name not in self.files:
            raise ValueError(f"{self.folder} has no {name}; it has {', '.join(self.files)}")
        try:
            with np.load(bytes_io.BytesIO(self.files[name]), allow_pickle=False) as file:
                return {key: file[key] for key in file.files}
        except Exception as error:  # whatever zip and numpy make of foreign bytes
            raise ValueError(f"{self.folder / name} cannot be read ({one_line(error)})") from None


def read_bundle(folder: Path | str) -> Bundle:
    """Read a bundle.

    Raises:
        ValueError: not a bundle, of a newer version, a file missing or altered; one line says which.
    """
    folder = Path(folder)
    path = folder / CONTRACT
    try:
        document = json.loads(path.read_bytes())
    except OSError:
        raise ValueError(f"{folder} is not a bundle (it has no {CONTRACT}); {_WANTED}") from None
    except ValueError:
        raise ValueError(f"{path} is not JSON; {_WANTED}") from None
    contract = check_contract(document, origin=str(path))
    files = {}
    for name, entry in contract.files.items():
        if Path(name).name != name or name == CONTRACT:
            raise ValueError(f"{path} names a file {name!r}; allowed are files of the bundle's folder")
        try:
            data = (folder / name).read_bytes()
        except OSError as error:
            raise ValueError(f"{folder / name} cannot be read ({error.strerror}); {_WANTED}") from None
        if hashlib.sha256(data).hexdigest() != entry.sha256:
            raise ValueError(f"{folder / name} is altered (its sha256 is not that of {CONTRACT}); {_WANTED}")
        files[name] = data
    if not files:
        raise ValueError(f"{folder} holds no policy; {_WANTED}")
    return Bundle(folder, contract, files)


def check_contract(document: object, *, origin: str) -> Contract:
    """Return the contract that a JSON document holds.

    Raises:
        ValueError: it holds none, or one of a newer version, or a key or type is wrong.
    """
    said = document.get("format") if isinstance(document, dict) else None
    known = re.fullmatch(r"pregrasp_jax bundle (\d+)", said) if isinstance(said, str) else None
    if known is None:
        raise ValueError(f"{origin} is not the contract of a bundle; {_WANTED}")
    if said != FORMAT:
        raise ValueError(f"{origin} is of another version of this package ({said}; this one reads {FORMAT})")
    try:
        return from_dict(document, Contract)  # pyright: ignore[reportArgumentType]
    except ValueError as error:
        raise ValueError(f"{origin}: {error}") from None
