# SPDX-License-Identifier: Apache-2.0
import signal

import pytest
from small_node import SMALL_NODE

from viability_bounds_pkg.testing.executables import started


def assert_ends_well(done):
    assert done.returncode == 0, done.stderr
    assert not {word for word in ("Traceback", "Exception", "Error") if word in done.stderr}


INTERRUPTED = f"""{SMALL_NODE}
from std_msgs.msg import Header

class Busy(SmallNode):
    NAME = "busy"

    def __init__(self):
        super().__init__()
        self.out = self.create_publisher(Header, "out", 1)
        self.create_timer(0.01, self.work)

    def work(self):
        os.kill(os.getpid(), int(sys.argv[1]))
        for _ in range(1000):
            self.out.publish(Header())

sys.exit(run(Busy, ["busy"]))
"""


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_lets_the_callback_end_that_it_interrupts(sent):
    done = started("-c", INTERRUPTED, int(sent))
    assert_ends_well(done)


INTERRUPTED_AT_START = f"""{SMALL_NODE}

class Slow(SmallNode):
    NAME = "slow"

    def __init__(self):
        super().__init__()
        try:
            os.kill(os.getpid(), signal.SIGINT)
            signal.pause()
        except KeyboardInterrupt:
            pass  # as where compiled code calls back

sys.exit(run(Slow, ["slow"]))
"""


def test_an_interrupt_that_is_lost_during_the_start_ends_the_node_all_the_same():
    done = started("-c", INTERRUPTED_AT_START)
    assert_ends_well(done)


REFUSED = f"""{SMALL_NODE}
from viability_bounds_pkg.exceptions import ArmSafetyError

class Refused(SmallNode):
    NAME = "refused"

    def __init__(self):
        raise ArmSafetyError("it cannot be")

code = run(Refused, ["refused"])
os.kill(os.getpid(), signal.SIGINT)
sys.exit(code)
"""


def test_an_interrupt_while_a_program_ends_changes_nothing():
    done = started("-c", REFUSED)
    assert (done.returncode, done.stderr) == (1, "error: it cannot be\n")
