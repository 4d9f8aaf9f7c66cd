# Real front ends, from PyPI in an environment of their own, on virtual hardware (docs/klippy-api.md).
.PHONY: frontends frontends-api frontends-pages octoprint moonraker

MOONRAKER := moonraker==0.11.0
# A name with = would be a variable where make is called with it.
MOONRAKER_STAMP := build/frontends/$(subst ==,-,$(MOONRAKER))

$(MOONRAKER_STAMP):
	python3 -m venv build/frontends
	build/frontends/bin/pip install --quiet --disable-pip-version-check $(MOONRAKER)
	touch $@

moonraker: setup
	@$(MAKE) --no-print-directory $(MOONRAKER_STAMP) || true # those who need it say so

# Builds of Mainsail and Fluidd (tests/frontends/browser.py names them); without them, or without Chromium,
# frontends-pages says that it skips them.
FRONT_ENDS ?= ../shared/frontends

frontends: frontends-api frontends-pages

frontends-api: moonraker
	@if [ -e $(MOONRAKER_STAMP) ]; then \
	  $(BIN)/python -m tests.frontends.moonraker build/frontends/bin/moonraker; \
	else echo "skipped: Moonraker; pip could not install $(MOONRAKER)"; fi

frontends-pages: moonraker
	@if [ -e $(MOONRAKER_STAMP) ]; then \
	  $(BIN)/python -m tests.frontends build/frontends/bin/moonraker $(FRONT_ENDS); \
	else echo "skipped: Mainsail and Fluidd; pip could not install $(MOONRAKER)"; fi

OCTOPRINT := octoprint==1.11.8

# 200 MB in an environment of its own: part of `make thorough` (docs/pty.md).
build/octoprint/$(OCTOPRINT):
	python3 -m venv build/octoprint
	build/octoprint/bin/pip install --quiet --disable-pip-version-check $(OCTOPRINT)
	touch $@

octoprint: setup build/octoprint/$(OCTOPRINT)
	$(BIN)/python -m tests.frontends.octoprint build/octoprint/bin/octoprint
