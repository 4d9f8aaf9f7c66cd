# More eyes on what is there: a second compiler and linters for C, coverage, and what is shipped.
.PHONY: lint-c clang-c coverage package

LINTED_C := $(filter %.c,$(filter firmware/% nodes/% coordinator/% bench/%,$(C_SOURCES)))
# What the sanitizers' headers or a build's constants are needed for is compiled by its own makefile or test.
CLANG_C := $(filter-out tests/stages/avr_board.c tests/fuzz/driver.c tests/firmware/held_read.c tests/mutation/hits.c,$(filter %.c,$(C_SOURCES)))

# All C with clang, where there is one: it sees other things than gcc.
clang-c:
	@if command -v clang >/dev/null; then clang $(C_WARNINGS) -Itests -fsyntax-only $(CLANG_C); \
	else echo "no clang: C is checked with gcc alone (apt-get install clang)"; fi

# .clang-tidy and tests/cppcheck.txt say what is off, and why. A minute of CPU: in .ci/run, not in make check.
lint-c:
	@for tool in clang-tidy cppcheck; do command -v $$tool >/dev/null \
	  || { echo "make lint-c needs: apt-get install --no-install-recommends clang clang-tidy cppcheck" >&2; exit 1; }; done
	cppcheck --std=c11 --enable=warning,performance,portability,style --inline-suppr --quiet --error-exitcode=1 \
	  --suppressions-list=tests/cppcheck.txt -j2 -I. -Ifirmware $(LINTED_C)
	printf '%s\n' $(LINTED_C) | xargs -P 2 -n 12 sh -c 'clang-tidy --quiet "$$@" -- -std=gnu11 -I. -Ifirmware 2>/dev/null' sh

# A source distribution becomes a wheel, which prints in a new virtual environment far from here.
package: setup
	$(BIN)/python -m tests.package.prove $(PYTHONS)

# Lines of C and Python that the tests run; fails below the bounds. COVERAGE="--verbose": the lines that are not.
coverage: setup
	$(BIN)/python -m tests.measure_coverage $(COVERAGE)
