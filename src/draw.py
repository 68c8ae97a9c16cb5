"""`python -m src.draw`: see `meshspiral.commands.draw`."""

from meshspiral.commands.draw import main

if __name__ == "__main__":
    main()
