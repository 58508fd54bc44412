#define DOCTEST_CONFIG_IMPLEMENT
#include <doctest/doctest.h>

int main(int argc, char** argv) {
  doctest::Context context(argc, argv);
  context.setOption("success", true);  // PlatformIO counts cases from the report of the passed ones
  return context.run();
}
