# SPDX-License-Identifier: Apache-2.0
from glob import glob

from setuptools import find_packages, setup

package_name = 'node_core'

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
    description='The thin layer over rclpy shared by all estimator nodes: ports, parameters, diagnostics, lock-step.',
    license='Apache-2.0',
    entry_points={'console_scripts': ['compose = node_core.compose:main']},
)
