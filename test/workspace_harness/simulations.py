# SPDX-License-Identifier: Apache-2.0
"""Simulations by seed for sweeps: ``--simulate workspace_harness.simulations:NAME``.

Each function takes (seed, path) and writes one bag with truth. They are the scenarios behind the fixtures,
with other seeds.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path


def imu_hand_held(seed: int, path: Path) -> None:
    """imu_kalman: 30 s turned and swung in a hand; truth on /truth/orientation."""
    from imu_kalman.fixtures import HAND, write_bag

    write_bag(path, replace(HAND, seed=seed), 30.0)


def ship_beam_sea(seed: int, path: Path) -> None:
    """ship_inclinometer: 120 s of an irregular beam sea; truth on /truth/orientation."""
    from ship_inclinometer.fixtures import write_bag
    from ship_inclinometer.simulation import scenario

    write_bag(path, scenario('beam', duration=120.0, rate=50.0, magnetometer_rate=10.0), seed)


def ev_good_road(seed: int, path: Path) -> None:
    """ev_velocity: 26 s on a good road, GPS 10 Hz; truth on /truth/velocity (twist.linear.x)."""
    from ev_velocity.fixtures import LENGTH, write_drive
    from ev_velocity.scenarios import SCENARIOS, simulate

    write_drive(path, simulate(SCENARIOS['good_road_10hz'], seed, LENGTH))


def uav_s_turns(seed: int, path: Path) -> None:
    """ins_gps: 60 s of S-turns, GNSS 1 Hz with correlated errors; truth on /truth/odometry."""
    from ins_gps.fixtures import START, write_run
    from ins_gps.simulation import DGPS, Scenario
    from ins_gps.simulation_gnss import simulate

    budget = replace(DGPS, white=False)
    scenario = Scenario(trajectory='s_turns', duration=60.0, imu_rate=50.0, start=START, budget=budget)
    write_run(path, simulate(scenario, seed))


def quad_stand(seed: int, path: Path) -> None:
    """quad_control: 8 s of swinging on the stand without motors; truth on /truth/odometry."""
    from bag_tools.bag import BagWriter, zeroed
    from quad_control import codec
    from quad_control.craft import CraftParams, ImuErrorParams
    from quad_control.fixtures import START
    from quad_control.simulation import QuadSimulator

    plant = QuadSimulator(CraftParams(pinned=True), ImuErrorParams(), seed=seed, roll=0.17)
    imu, truth = zeroed(codec.IMU), zeroed(codec.ODOMETRY)
    offset = START - plant.stamp
    with BagWriter(path, compression='zstd', overwrite=True) as bag:
        bag.add('/imu/data_raw', codec.IMU)
        bag.add('/truth/odometry', codec.ODOMETRY)
        for _ in range(round(8.0 * 200)):
            state = plant.truth()
            codec.encode_truth(state._replace(stamp=state.stamp + offset), truth)
            bag.write('/truth/odometry', state.stamp + offset, truth)
            sample = plant.sense()
            codec.encode_imu(sample._replace(stamp=sample.stamp + offset), imu)
            bag.write('/imu/data_raw', sample.stamp + offset, imu)
            plant.advance(None)
