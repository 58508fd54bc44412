"""PlatformIO's doctest runner without its download of the library: <doctest/doctest.h> is the machine's own."""

from platformio.test.runners.doctest import DoctestTestRunner


class CustomTestRunner(DoctestTestRunner):
    EXTRA_LIB_DEPS = None
