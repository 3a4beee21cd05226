"""The cost of reading a result file in bytes that are read, which does not depend on how busy the machine is."""

import contextlib
import io
from unittest import mock

from hjbjax.solution import files


class Counting(io.FileIO):
    """A file that notes how many bytes each read returns."""

    def __init__(self, path, mode, noted):
        super().__init__(path, mode)
        self.noted = noted

    def read(self, size=-1):
        data = super().read(size)
        self.noted.append(len(data))
        return data


@contextlib.contextmanager
def counted_reads():
    """Context with a list of the bytes that each read of a result file returned."""
    noted = []
    with mock.patch.object(files, "open", lambda path, mode: Counting(path, mode, noted), create=True):
        yield noted
