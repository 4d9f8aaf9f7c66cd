# Real front ends, from PyPI in an environment of their own, on virtual hardware (docs/klippy-api.md).
.PHONY: frontends octoprint

MOONRAKER := moonraker==0.11.0
# A name with = would be a variable where make is called with it.
MOONRAKER_STAMP := build/frontends/$(subst ==,-,$(MOONRAKER))

$(MOONRAKER_STAMP):
	python3 -m venv build/frontends
	build/frontends/bin/pip install --quiet --disable-pip-version-check $(MOONRAKER)
	touch $@

# Builds of Mainsail and Fluidd (tests/frontends/browser.py names them); without them, or without Chromium, the
# second line says that it skips them.
FRONT_ENDS ?= ../shared/frontends

frontends: setup
	@if $(MAKE) --no-print-directory $(MOONRAKER_STAMP); then \
	  $(BIN)/python -m tests.frontends.moonraker build/frontends/bin/moonraker && \
	  $(BIN)/python -m tests.frontends build/frontends/bin/moonraker $(FRONT_ENDS); \
	else echo "skipped: Moonraker and the front ends; pip could not install $(MOONRAKER)"; fi

OCTOPRINT := octoprint==1.11.8

# 200 MB in an environment of its own: part of `make thorough` (docs/pty.md).
build/octoprint/$(OCTOPRINT):
	python3 -m venv build/octoprint
	build/octoprint/bin/pip install --quiet --disable-pip-version-check $(OCTOPRINT)
	touch $@

octoprint: setup build/octoprint/$(OCTOPRINT)
	$(BIN)/python -m tests.frontends.octoprint build/octoprint/bin/octoprint
