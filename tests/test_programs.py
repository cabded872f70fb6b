"""What has to be said before JAX starts, each in a process of its own."""

import subprocess
import sys


def test_two_devices_and_64_bit_types():
    done = subprocess.run([sys.executable, "-m", "tests.devices_and_types"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.endswith("done\n"), done.stderr[-3000:]
