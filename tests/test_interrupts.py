"""Ctrl-C ends a command with status 130, without a traceback, and leaves nothing half done."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import pytest

from sidestep import _interrupts


@pytest.fixture(autouse=True)
def as_in_a_terminal():
    """Ctrl-C raises KeyboardInterrupt, however these tests were started."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def interrupt():
    signal.raise_signal(signal.SIGINT)


def program(body):
    """A program that claims Ctrl-C and prints "ready" as its first line, running."""
    # A background shell has its children ignore Ctrl-C.
    text = (
        "import os, signal, sys, time\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from sidestep import _interrupts\n_interrupts.claim()\n"
    )
    return subprocess.Popen(
        [sys.executable, "-c", text + textwrap.dedent(body)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def ended(child, *, interrupts=1):
    assert child.stdout.readline() == "ready\n"
    for _ in range(interrupts):
        time.sleep(0.2)
        child.send_signal(signal.SIGINT)
    out, err = child.communicate(timeout=60)
    return child.returncode, out, err


def test_outside_held_a_command_ends_at_once_with_130_and_no_traceback():
    code, out, err = ended(
        program(
            "sys.stdout = open(1, 'w', closefd=False)\nprint('kept')\n"
            "os.write(1, b'ready\\n')\ntime.sleep(60)"
        )
    )
    assert (code, out, err) == (130, "kept\n", "")


def test_an_interrupt_during_an_import_is_no_import_error(tmp_path):
    """A KeyboardInterrupt inside an extension module's start becomes an ImportError, and a traceback."""
    (tmp_path / "slow.py").write_text(
        "import time\nprint('ready', flush=True)\ntry:\n    time.sleep(60)\n"
        "except KeyboardInterrupt:\n    raise ImportError('as NumPy does')\n"
    )
    code, _, err = ended(program(f"sys.path.insert(0, {str(tmp_path)!r})\nimport slow"))
    assert (code, err) == (130, "")


def test_an_interrupt_while_xla_computes_does_not_crash():
    code, _, err = ended(
        program(
            """
            import jax, jax.numpy as jnp, threading
            work = jax.jit(lambda x: jax.lax.fori_loop(0, 10**9, lambda i, x: jnp.sin(x) + i, x))
            threading.Thread(target=lambda: work(jnp.ones(64)).block_until_ready(), daemon=True).start()
            print('ready', flush=True)
            time.sleep(60)
            """
        )
    )
    assert (code, err) == (130, "")


def test_within_held_work_ends_at_a_check_and_what_follows_is_done():
    code, out, err = ended(
        program(
            """
            print('ready', flush=True)
            try:
                with _interrupts.held():
                    try:
                        for step in range(600):
                            begun = time.monotonic()
                            while time.monotonic() < begun + 0.05:
                                pass
                            print('whole step')
                            _interrupts.check()
                    finally:
                        print('saved')
            except KeyboardInterrupt:
                sys.exit(130)
            """
        )
    )
    assert code == 130
    assert out.splitlines()[-2:] == ["whole step", "saved"]
    assert "Ctrl-C again" in err
    assert "Traceback" not in err


def test_a_second_interrupt_ends_a_step_that_takes_long():
    child = program(
        """
        print('ready', flush=True)
        with _interrupts.held():
            begun = time.monotonic()
            while time.monotonic() < begun + 60:
                time.sleep(0.01)
        """
    )
    code, _, err = ended(child, interrupts=2)
    assert code == 130
    assert "Traceback" not in err


def test_what_has_to_happen_first_happens_the_latest_first_and_a_failure_does_not_stop_the_rest():
    code, out, _ = ended(
        program(
            """
            with (
                _interrupts.before_leaving(lambda: _interrupts.say('first')),
                _interrupts.before_leaving(lambda: 1 / 0),
                _interrupts.before_leaving(lambda: _interrupts.say('last')),
            ):
                with _interrupts.before_leaving(lambda: _interrupts.say('over')):
                    pass
                print('ready', flush=True)
                time.sleep(60)
            """
        )
    )
    assert (code, out) == (130, "last\nfirst\n")


@pytest.mark.parametrize(
    "work, moment",
    [
        ("from sidestep.store.files import write_bytes; write_bytes(PLACE, b'all of it')", "fsync"),
        ("from sidestep.store.files import write_bytes; write_bytes(PLACE, b'all of it')", "replace"),
        ("from sidestep.store.outputs import try_outputs; try_outputs(files=[PLACE])", "fsync"),
    ],
)
def test_an_interrupt_just_before_a_file_is_in_place_leaves_nothing_beside_it(work, moment, tmp_path):
    code, _, err = ended(
        program(f"""
            os.write(1, b"ready\\n")
            PLACE, real = {str(tmp_path / "new" / "page.html")!r}, os.{moment}
            def interrupted(*arguments):
                os.kill(os.getpid(), signal.SIGINT)
                return real(*arguments)
            os.{moment} = interrupted
            {work}
            """),
        interrupts=0,
    )
    assert (code, err) == (130, "")
    assert [path for path in tmp_path.rglob("*") if path.is_file() or path.name != "new"] == []


def test_an_ignored_interrupt_stays_ignored():
    """A shell without job control starts background jobs that way."""
    body = (
        "from sidestep import _interrupts as i\ni.claim()\nprint('ready', flush=True)\n"
        "import time\nwith i.held(): time.sleep(1)"
    )
    child = subprocess.Popen(
        ["sh", "-c", 'trap "" INT; exec "$0" -c "$1"', sys.executable, body],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert ended(child) == (0, "", "")


def test_a_program_of_others_gets_keyboard_interrupt_at_a_check_and_its_handler_back():
    before, steps = signal.getsignal(signal.SIGINT), []

    def work():
        with _interrupts.held():
            interrupt()
            steps.append("went on")
            _interrupts.check()
            steps.append("never")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert steps == ["went on"]
    assert signal.getsignal(signal.SIGINT) is before
    with pytest.raises(KeyboardInterrupt):
        interrupt()


def test_a_program_of_others_is_interrupted_by_the_second_at_once():
    def work():
        with _interrupts.held():
            interrupt()
            interrupt()
            pytest.fail("the second one was not heard")

    with pytest.raises(KeyboardInterrupt):
        work()


def test_an_interrupt_after_the_last_check_is_not_lost():
    with pytest.raises(KeyboardInterrupt), _interrupts.held():
        interrupt()


def test_an_answered_interrupt_is_raised_once_and_forgotten():
    with _interrupts.held():
        with _interrupts.held():
            interrupt()
            with pytest.raises(KeyboardInterrupt):
                _interrupts.check()
        _interrupts.check()
    _interrupts.check()
    with _interrupts.held():
        _interrupts.check()


def test_outside_the_main_thread_held_changes_nothing():
    seen = []

    def work():
        with _interrupts.held():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [signal.getsignal(signal.SIGINT)]


def test_a_handler_of_the_program_stays(monkeypatch):
    heard = []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append(os.getpid()))
    try:
        with _interrupts.held():
            interrupt()
            _interrupts.check()
    finally:
        signal.signal(signal.SIGINT, before)
    assert heard == [os.getpid()]
