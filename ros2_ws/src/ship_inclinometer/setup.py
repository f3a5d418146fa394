# SPDX-License-Identifier: Apache-2.0
from glob import glob

from setuptools import find_packages, setup

package_name = 'ship_inclinometer'

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
    package_data={package_name: ['py.typed', 'display.html']},
    zip_safe=False,
    maintainer='Estimator workspace maintainers',
    maintainer_email='maintainers@estimator-workspace.invalid',
    description="A ship's electronic inclinometer: attitude at sea, roll analysis, alarms, NMEA and Modbus.",
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            f'{node} = {package_name}.nodes.{node}:main'
            for node in (
                'ship_simulator',
                'attitude_estimator',
                'roll_analysis',
                'alarm_monitor',
                'nmea_bridge',
                'modbus_bridge',
                'display',
                'hmc5883l_driver',
                'calibration',
            )
        ]
    },
)
