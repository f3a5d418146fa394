# SPDX-License-Identifier: Apache-2.0
from glob import glob

from setuptools import find_packages, setup

package_name = 'ins_gps'

setup(
    name=package_name,
    version='0.1.0',
    packages=find_packages(exclude=['test']),
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + package_name]),
        ('share/' + package_name, ['package.xml']),
        ('share/' + package_name + '/config', glob('config/*.yaml')),
    ],
    install_requires=['setuptools'],
    extras_require={'test': ['pytest']},
    package_data={package_name: ['py.typed']},
    zip_safe=True,
    maintainer='Estimator workspace maintainers',
    maintainer_email='maintainers@estimator-workspace.invalid',
    description='Tightly coupled INS/GPS with carrier-phase differences and DGPS.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            f'{node} = {package_name}.nodes.{node}:main'
            for node in (
                'ins_gps_estimator',
                'uav_simulator',
                'rinex_driver',
                'ublox_driver',
                'nmea_driver',
                'rtcm_driver',
                'dgps_base',
                'input_doctor',
                'smoother',
            )
        ]
    },
)
