"""Configurations that people really use: users' own ones, and those that the peer publishes.

They are not part of the project: without ../shared these tests are skipped. Each file that is expected is
named, so that one more file there breaks nothing.
"""

from pathlib import Path

import pytest

from coordinator.assembly.check import check_config
from coordinator.assembly.load import load_machine

REAL = Path(__file__).parents[3] / ".." / "shared" / "data" / "config" / "real"


def _names(text: str) -> list[str]:
    return text.split()


USERS = _names(
    """
    Alex3DLabs_Klipper_Configs_Creality_CR_10V3_printer_cfg
    Alex3DLabs_Klipper_Configs_Creality_Ender_3_V2_printer_cfg
    Alex3DLabs_Klipper_Configs_Voron_0_0_2R1_printer_cfg
    Alex3DLabs_Klipper_Configs_Voron_2_4_R2_TAPConfig_printer_cfg
    AquaMorph_klipper_config_printer_ender3_cfg Capp3_klipper_config_tevo_sbase_cfg
    Dviros_Klipper_Configs_hardware_printer_cfg IggyTheWolf_trident_klipper_config_printer_cfg
    MotorDynamicsLab_LDOVoron2_Firmware_octopus_printer_rev_a_cfg
    NerdyGriffin_Klipper_Config_V03048_printer_cfg VoronDesign_Voron_0_Firmware_bigtreetech_skr_3_ez_cfg
    VoronDesign_Voron_0_Firmware_bigtreetech_skr_mini_e3_v3_0_cfg
    VoronDesign_Voron_0_Firmware_bigtreetech_skr_pico_v1_0_cfg
    VoronDesign_Voron_2_firmware_klipper_configurations_M8P_Voron2_M8P_v1_0_config_cfg
    VoronDesign_Voron_2_firmware_klipper_configurations_SKR_1_3_Voron2_SKR_13_Config_cfg
    VoronDesign_Voron_2_firmware_klipper_configurations_Spider_Voron2_Spider_Config_cfg
    VoronDesign_Voron_Switchwire_Firmware_einsy_config_cfg
    VoronDesign_Voron_Switchwire_Firmware_skr_mini_e3_v3_config_cfg
    VoronDesign_Voron_Trident_Firmware_M8P_Trident_M8P_v2_0_config_cfg
    bassco_klipper_configs_ender3_printer_cfg bcdiaconu_klipper_config_printer_cfg
    cupsster_FLSUN_SR_Klipper_Config_Configuration_printer_cfg jmerdich_klipper_config_printer_cfg
    maaad_klipper_config_Ender3Pro_printer_cfg mchestr_klipper_config_iiip_printer_cfg
    mdvorak_klipper_config_printer_cfg nofuturekid_klipper_config_vzbot_330_printer_cfg
    th33xitus_klipper_config_printer_cfg
    """
)
PARTS = _names(
    """
    example sample-aliases sample-bigtreetech-ebb-canbus-v1.0 sample-bigtreetech-exp-mot
    sample-cartographer-v3 sample-corexyuv sample-glyphs sample-huvud-v0.61 sample-idex sample-macros
    sample-mmu2s-diy sample-pwm-tool
    """
)
"""Of the peer's own, those without [mcu] and [printer]: no host takes them alone."""
WHOLE = _names(
    """
    example-cartesian example-corexz example-deltesian example-generic-caretesian example-hybrid-corexy
    example-hybrid-corexz example-polar example-winch generic-alligator-r2
    generic-bigtreetech-e3-rrf-v1.1 generic-bigtreetech-manta-m5p generic-bigtreetech-manta-m8p-v1.1
    generic-bigtreetech-octopus-max-ez generic-bigtreetech-octopus-pro-v1.0
    generic-bigtreetech-octopus-pro-v1.1 generic-bigtreetech-octopus-v1.1 generic-bigtreetech-skr-3
    generic-bigtreetech-skr-cr6-v1.0 generic-bigtreetech-skr-mini-e3-v1.0
    generic-bigtreetech-skr-mini-e3-v2.0 generic-bigtreetech-skr-mini generic-bigtreetech-skr-pico-v1.0
    generic-bigtreetech-skr-pro generic-bigtreetech-skr-v1.4 generic-creality-v4.2.7 generic-duet2-duex
    generic-duet2-maestro generic-duet2 generic-duet3-6hc generic-duet3-6xd generic-duet3-mini
    generic-einsy-rambo generic-fysetc-cheetah-v1.1 generic-fysetc-cheetah-v1.2
    generic-fysetc-cheetah-v2.0 generic-fysetc-s6-v2 generic-fysetc-s6 generic-fysetc-spider
    generic-ldo-leviathan-v1.2 generic-mellow-fly-cdy-v3 generic-mellow-fly-e3-v2
    generic-mellow-fly-gemini-v2 generic-melzi generic-mks-monster8 generic-mks-robin-e3
    generic-mks-robin-nano-v1 generic-mks-robin-nano-v2 generic-mks-robin-nano-v3 generic-printrboard
    generic-prusa-buddy generic-radds generic-rambo generic-ramps generic-simulavr generic-smoothieboard
    generic-th3d-ezboard-v2.0 generic-ultimaker-ultimainboard-v2 printer-adimlab-2018
    printer-anet-a8-2019 printer-anet-e10-2018 printer-anet-e16-2019 printer-anycubic-i3-mega-2017
    printer-anycubic-kobra-go-2022 printer-anycubic-kossel-2016 printer-anycubic-kossel-plus-2017
    printer-anycubic-vyper-2021 printer-artillery-sidewinder-x2-2022 printer-biqu-b1-se-plus-2022
    printer-bq-hephestos-2014 printer-creality-cr10-2017 printer-creality-cr10-v3-2020
    printer-creality-cr10mini-2017 printer-creality-cr10s-pro-v2-2020 printer-creality-cr30-2021
    printer-creality-cr5pro-ht-2022 printer-creality-cr6se-2020 printer-creality-ender2-2017
    printer-creality-ender2pro-2021 printer-creality-ender2pro-hc32-2022 printer-creality-ender3-2018
    printer-creality-ender3-s1plus-2022 printer-creality-ender3-v2-2020
    printer-creality-ender3-v2-neo-2022 printer-creality-ender3pro-2020 printer-creality-ender5-s1-2023
    printer-creality-ender5plus-2019 printer-creality-ender5pro-2020 printer-elegoo-neptune2-2021
    printer-eryone-er20-2021 printer-flashforge-creator-pro-2018 printer-flsun-q5-2020
    printer-flsun-qqs-2020 printer-geeetech-301-2019 printer-geeetech-A10T-A20T-2021
    printer-hiprecy-leo-2019 printer-longer-lk4x-2022 printer-lulzbot-mini1-2016
    printer-lulzbot-mini2-2018 printer-lulzbot-taz6-dual-v3-2017 printer-makergear-m2-2012
    printer-makergear-m2-2016 printer-monoprice-select-mini-v1-2016
    printer-monoprice-select-mini-v2-2018 printer-prusa-mini-plus-2020 printer-sovol-sv05-2022
    printer-sovol-sv06-2022 printer-sovol-sv06-plus-2023 printer-sunlu-t3-2022
    printer-tevo-tarantula-pro-2020 printer-tronxy-p802e-2020 printer-tronxy-p802m-2020
    printer-tronxy-x5s-2018 printer-tronxy-x5sa-pro-2020 printer-tronxy-x5sa-v6-2019
    printer-tronxy-x8-2018 printer-twotrees-sapphire-plus-sp-5-v1.1-2021
    printer-twotrees-sapphire-pro-sp-3-2020 printer-velleman-k8200-2013 printer-velleman-k8800-2017
    printer-voxelab-aquila-2021 printer-wanhao-duplicator-6-2016 printer-wanhao-duplicator-i3-mini-2017
    printer-wanhao-duplicator-i3-plus-mark2-2019 printer-wanhao-duplicator-i3-v2.1-2017 sample-multi-mcu
    """
)
"""Of the peer's own, those that it takes."""


def real(folder: str, name: str) -> str:
    path = REAL / folder / f"{name}.cfg"
    if not path.is_file():
        pytest.skip(f"there is no {path}")
    return str(path)


@pytest.mark.parametrize("name", USERS)
def test_a_users_machine_loads(name: str) -> None:
    path = real("users", name)
    assert check_config(path) == []
    load_machine(path)


def test_what_the_peer_takes_is_taken() -> None:
    paths = [real("klipper", name) for name in WHOLE]
    assert {Path(path).stem: problems for path in paths if (problems := check_config(path))} == {}


@pytest.mark.parametrize("name", PARTS)
def test_parts_of_machines_are_refused_as_such(name: str) -> None:
    problems = [str(problem) for problem in check_config(real("klipper", name))]
    assert any("there is no section [mcu]" in problem for problem in problems)


def test_nothing_but_that_is_wrong_with_what_they_are_parts_of(tmp_path: Path) -> None:
    """Joined with a machine, a second pair of carriages and others load, too."""
    whole = "[mcu]\nserial: /dev/ttyACM0\n"
    z = (
        "[carriage carriage_z]\naxis: z\nposition_endstop: 0\nposition_max: 100\nendstop_pin: ^PD3\n"
        "[stepper z]\ncarriages: carriage_z\nstep_pin: PL3\ndir_pin: PL1\nmicrosteps: 16\n"
        "rotation_distance: 8\n"
    )
    path = tmp_path / "corexyuv.cfg"
    path.write_text(f"{whole}{z}[include {real('klipper', 'sample-corexyuv')}]\n")
    machine = load_machine(str(path))
    waiting = {entry.section for entry in machine.unsupported}
    assert {"dual_carriage carriage_u", "dual_carriage carriage_v"} <= waiting
    refused = {rail.axis for rail in machine.rails if rail.homing.refused}
    assert refused == {"x", "y"}
