# Source me in the repository's root: PlatformIO that keeps its files in this checkout and asks no network for anything.
export PLATFORMIO_CORE_DIR="${PLATFORMIO_CORE_DIR:-$PWD/.piocore}"
export PLATFORMIO_SETTING_ENABLE_TELEMETRY=No
export PLATFORMIO_DISABLE_UPGRADE_CHECK=true
export PLATFORMIO_NO_ANSI=true
export PLATFORMIO_DISABLE_PROGRESSBAR=true
