# SPDX-License-Identifier: Apache-2.0
"""A serial line for tests that can be unplugged."""

import contextlib
import os
import pty
import select
import tty


class Cable:
    """A pseudo-terminal behind a link, which is unplugged and plugged in again."""

    def __init__(self, folder):
        self.link = str(folder / 'tty')
        self.plug()

    def plug(self):
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self.link)
        os.symlink(os.ttyname(self.slave), self.link)

    def unplug(self):
        os.close(self.master)
        os.close(self.slave)
        os.unlink(self.link)

    def read(self):
        """Return what was written: the other end of a pseudo-terminal gets it a little later."""
        data = b''
        while select.select([self.master], [], [], 0.02)[0]:
            data += os.read(self.master, 65536)
        return data
