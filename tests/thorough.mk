# What takes too long for `make test`. Each part can run alone; `make thorough` runs all and prints one table.
SIM_SEEDS ?= 2000
SEED ?= 1
SAMPLE ?= 300
AREA ?=
MINUTES ?= 120
STEPS ?=

.PHONY: thorough sim loss mutants mutation soak arm

thorough: setup
	$(BIN)/python -m tests.thorough.run --seeds $(SIM_SEEDS) --seed $(SEED) --sample $(SAMPLE) \
	  --fuzz-seconds $(FUZZ_SECONDS) --soak-minutes $(MINUTES) $(STEPS)

# Whole machines in virtual time, each seed with other faults (docs/simulation.md).
sim: setup
	$(BIN)/canductor simulate --seeds 0:$(SIM_SEEDS)

# 300 prints on a bus that loses 5 % of the frames, 100 on one that loses 10 %: all complete.
loss: setup
	$(BIN)/canductor simulate loss_5_percent --seeds 0:300
	$(BIN)/canductor simulate loss_10_percent --seeds 0:100

# Do the simulation and the tests find anything? Plants bugs and looks (tests/sim/mutants.toml).
mutants: setup
	$(BIN)/python tests/sim/mutants.py

# Changes one operator, literal, condition or statement at a time; survivors are listed (tests/mutation).
mutation: setup
	$(BIN)/python -m tests.mutation.run --seed $(SEED) --sample $(SAMPLE) $(if $(AREA),--area $(AREA))

# A service prints on virtual nodes while clients come and go: memory, descriptors, threads must not grow.
soak: setup
	$(BIN)/python -m tests.soak.run --minutes $(MINUTES)

# The processors of small computers, emulated: C tests, and streams and simulated runs that must be those of this one.
arm: setup
	$(BIN)/python -m tests.arm.prove $(PROCESSORS)
