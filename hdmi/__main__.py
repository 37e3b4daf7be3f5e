"""`python -m hdmi VERB ...`."""

from hdmi.commands.verbs import main

if __name__ == "__main__":
    main()
