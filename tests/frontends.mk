# Real front ends, from PyPI in an environment of their own, on virtual hardware (docs/klippy-api.md).
.PHONY: frontends

MOONRAKER := moonraker==0.11.0

build/frontends/$(MOONRAKER):
	python3 -m venv build/frontends
	build/frontends/bin/pip install --quiet --disable-pip-version-check $(MOONRAKER)
	touch $@

frontends: setup build/frontends/$(MOONRAKER)
	$(BIN)/python -m tests.frontends.moonraker build/frontends/bin/moonraker
