# SPDX-License-Identifier: Apache-2.0
from glob import glob

from setuptools import find_packages, setup

package_name = 'bag_tools'

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
    package_data={package_name: ['py.typed', 'mappings/*.yaml']},
    zip_safe=True,
    maintainer='Estimator workspace maintainers',
    maintainer_email='maintainers@estimator-workspace.invalid',
    description='Play, record, run offline, score, report and import rosbags for estimator graphs.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'play = bag_tools.nodes.play:main',
            'record = bag_tools.nodes.record:main',
            'offline = bag_tools.offline:main',
            'score = bag_tools.score:main',
            'report = bag_tools.report:main',
            'import = bag_tools.import_data:main',
            'info = bag_tools.info:main',
            'compare = bag_tools.compare:main',
            'sweep = bag_tools.sweep:main',
        ]
    },
)
