"""``duffing-env evaluate`` without an installation: python evaluate.py --help."""

from agents.cli import run_script
from agents.commands.evaluate import Evaluate

if __name__ == "__main__":
    run_script(Evaluate.run, Evaluate)
