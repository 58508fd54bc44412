"""`python -m linkpose` is `linkpose`."""

from linkpose.cli import main

main()
