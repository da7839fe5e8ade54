"""Run ``duffing-env train`` without an installation: python train.py --help."""

from agents.commands.train_command import main

if __name__ == "__main__":
    main("train.py")
