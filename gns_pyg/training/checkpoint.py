"""Checkpoints on disk: whole or not there, data only, every byte checked when read."""

import io
import zipfile
from typing import Any

import torch
from pytorch_lightning.plugins.io import TorchCheckpointIO

from gns_pyg.errors import CheckpointError
from gns_pyg.files import whole

REMEDY = "resume from another checkpoint, or train anew in another folder"


class Checkpoints(TorchCheckpointIO):
    """How Lightning stores checkpoints here.

    Lightning's own way writes to the system's temporary folder and moves the file; where that is another file system,
    the move is a copy, which a kill leaves half done under the final name.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Writes under a temporary name beside `path`, then renames.

        Raises:
            StorageError: if it cannot be written; what was at `path` before stays.
        """
        with whole(path) as temporary:
            torch.save(checkpoint, content := io.BytesIO())
            temporary.write_bytes(content.getbuffer())

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = True) -> dict[str, Any]:
        """Reads plain data only, on the CPU, whatever the arguments say.

        Raises:
            CheckpointError: if a byte differs from what was written, or the file holds anything but plain data.
        """
        try:
            with zipfile.ZipFile(path) as archive:
                packed = [entry.filename for entry in archive.infolist() if entry.compress_type != zipfile.ZIP_STORED]
                damaged = packed[0] if packed else archive.testzip()  # torch itself does not compare checksums
            checkpoint = None if damaged else torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # zipfile's, the unpickler's and torch's own errors of damage are many
            damaged, checkpoint = f"{type(error).__name__}: {error}".splitlines()[0], None
        if not isinstance(checkpoint, dict):
            raise CheckpointError(path, f"damaged ({damaged})", "a checkpoint written by train.py", REMEDY)
        return checkpoint
