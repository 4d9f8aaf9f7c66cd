# Real front ends, from PyPI in an environment of their own, on virtual hardware (docs/klippy-api.md).
.PHONY: frontends octoprint

MOONRAKER := moonraker==0.11.0

build/frontends/$(MOONRAKER):
	python3 -m venv build/frontends
	build/frontends/bin/pip install --quiet --disable-pip-version-check $(MOONRAKER)
	touch $@

frontends: setup build/frontends/$(MOONRAKER)
	$(BIN)/python -m tests.frontends.moonraker build/frontends/bin/moonraker

OCTOPRINT := octoprint==1.11.8

# 200 MB in an environment of its own: part of `make thorough` (docs/pty.md).
build/octoprint/$(OCTOPRINT):
	python3 -m venv build/octoprint
	build/octoprint/bin/pip install --quiet --disable-pip-version-check $(OCTOPRINT)
	touch $@

octoprint: setup build/octoprint/$(OCTOPRINT)
	$(BIN)/python -m tests.frontends.octoprint build/octoprint/bin/octoprint
