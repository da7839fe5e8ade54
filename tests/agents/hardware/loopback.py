"""A slow rig for tests, and an instrument on a loopback socket that obeys SCPI strings, a simulated rig behind it."""

import socketserver
import threading
from collections import Counter

import numpy as np

from agents.hardware.clock import JumpingClock
from agents.hardware.simulated_plant import SimulatedPlant
from estimator import Channel, Rig

TRUTH = {"m": 1.05, "c": 1.1, "a": 145.0, "b": 9e4}

#: 2 Hz, sampled at 50 Hz.
RIG = Rig(
    0.02,
    input=Channel("N", limit=4.0, noise=0.01),
    output=Channel("m", range=0.08, noise=2e-5),
    guess={"m": (0.8, 1.25), "c": (0.5, 1.6), "a": (110.0, 180.0), "b": (4e4, 1.4e5)},
)

RIG_FILE = """
step = 0.02
[input]
unit = "N"
limit = 4.0
noise = 0.01
[output]
unit = "m"
range = 0.08
noise = 2e-5
[guess]
m = [0.8, 1.25]
c = [0.5, 1.6]
a = [110.0, 180.0]
b = [4e4, 1.4e5]
"""

TABLE = {
    "zero": "SOUR 0",
    "arm": "OUTP ON",
    "disarm": "OUTP OFF",
    "watchdog": "WDOG {seconds}",
    "set": "SOUR {u};:SOUR?",
    "read": "MEAS?",
    "upload": "DATA {values}",
    "play": "INIT",
    "outputs": "FETC:OUT?",
    "inputs": "FETC:IN?",
    "timeout": 600.0,
}


class Scpi:
    """The instrument. Its output, the rig's input, is ``self.plant.applied``, whoever is connected.

    Args:
        rig: behind it.
        fault: ``stall`` answers nothing until ``quiet`` is set, ``lose`` closes the connection, ``slow`` takes two and
            a half sampling steps for every fifth line.
        word: with which the lines begin that meet the fault.
        after: such lines that do not yet.

    Attributes:
        clock: of the instrument, and of the run where both are in one process.
        ticks: whether its time passes by itself, a sampling step at each output that is asked for: for a run in another
            process, whose clock jumps from tick to tick.
        answered: outputs that were given, sample by sample.
        stalled, quiet: whether it waits, and whether it is to go on.
    """

    def __init__(self, rig=RIG, fault=None, word="MEAS?", after=30):
        self.clock, self.ticks = JumpingClock(), False
        self.plant, self.fault, self.word, self.after = SimulatedPlant(rig, TRUTH, clock=self.clock), fault, word, after
        self.step, self.lines, self.heard, self.answered = rig.step, [], Counter(), 0
        self.lock, self.silence, self.block = threading.Lock(), 2.0, None
        self.stalled, self.quiet = threading.Event(), threading.Event()
        outer = self

        class Handler(socketserver.StreamRequestHandler):
            def handle(self):
                for line in self.rfile:
                    try:
                        answer = outer.obey(line.decode().strip())
                    except ConnectionError:
                        return
                    if answer is not None:
                        self.wfile.write(f"{answer}\n".encode())

        class Server(socketserver.ThreadingTCPServer):
            daemon_threads, allow_reuse_address, block_on_close = True, True, False

            def handle_error(self, request, client_address):
                pass  # a client that was killed

        self.server = Server(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    @property
    def resource(self):
        return f"TCPIP::127.0.0.1::{self.server.server_address[1]}::SOCKET"

    @property
    def applied(self):
        with self.lock:
            return self.plant.applied

    def close(self):
        self.quiet.set()
        self.server.shutdown()
        self.server.server_close()

    def obey(self, line):
        self.lines.append(line)
        word, _, value = line.partition(" ")
        if word == self.word and self.heard[word] >= self.after:
            self._fail()
        self.heard[word] += 1
        with self.lock:
            match word:
                case "MEAS?":
                    if self.ticks:
                        self.clock.wait(self.clock.now() + self.step)
                    self.answered += 1
                    return self.plant.read()
                case "WDOG":
                    self.silence = float(value)
                case "OUTP":
                    self.plant.arm(self.silence) if value == "ON" else self.plant.disarm()
                case "SOUR":
                    applied = self.plant.apply(float(value.partition(";")[0]))
                    return applied if value.endswith("?") else None
                case "DATA":
                    self.block = np.array([float(one) for one in value.split(",")])
                case "INIT":
                    self.block = [np.asarray(one).tolist() for one in self.plant.play(self.block)]
                case "FETC:OUT?" | "FETC:IN?":
                    return ",".join(map(repr, self.block["OUT?" in word]))

    def _fail(self):
        match self.fault:
            case "stall":
                self.stalled.set()
                self.quiet.wait()
            case "lose":
                raise ConnectionError
            case "slow" if self.heard[self.word] % 5 == 0:
                self.clock.wait(self.clock.now() + 2.5 * self.step)
