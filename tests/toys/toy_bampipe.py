"""The command line of bampipe on the toy stages; worker processes run this file too."""

from install_toys import install

from bampipe.cli import main

install()

if __name__ == "__main__":
    main()
