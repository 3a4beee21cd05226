"""``python -m hjbjax``: the command without its script."""

from hjbjax.cli.main import main

if __name__ == "__main__":
    main(prog_name="hjbjax")
