"""Trials that fail, in a separate module, so that the processes that run them load nothing else of the tests."""

import os
import signal
import time


class Trial:
    """Trials that note their starts. Number 2 kills its process the first time, 3 raises, and 4 always kills its
    process."""

    def __init__(self, folder):
        self.folder = folder

    def __call__(self, index):
        first = not self.beginnings(index)
        (self.folder / f"{index}-{os.getpid()}").touch()
        if index == 4 or (index == 2 and first):
            os.kill(os.getpid(), signal.SIGKILL)
        if index == 3:
            raise RuntimeError("the third never works")
        return {"square": index * index}

    def beginnings(self, index):
        return [*self.folder.glob(f"{index}-*")]


class Stalling(Trial):
    """Trials that note their starts. Number 2 does not end the first time."""

    def __call__(self, index):
        first = not self.beginnings(index)
        (self.folder / f"{index}-{os.getpid()}").touch()
        while index == 2 and first:
            time.sleep(1)
        return {"square": index * index}


class Endless:
    """A trial that notes its process and does not end."""

    def __init__(self, folder):
        self.folder = folder

    def __call__(self, index):
        (self.folder / f"{os.getpid()}").touch()
        while True:
            time.sleep(1)
