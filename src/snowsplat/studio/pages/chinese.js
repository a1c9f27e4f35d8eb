// @ts-nocheck
// `snowsplatChinese`: what the program tells in the studio, in Chinese; `told.js` adds more. A text without
// a line here remains English. In English, "#" stands for a number, and "{}" for any text, which is
// translated, too; in Chinese, {0} is the first of both.
globalThis.snowsplatChinese = (() => {
    const TEXTS = {
        // Both reports
        'The photos: {}': '照片：{0}',
        'The scene: {}': '场景：{0}',
        'good': '好',
        'usable': '可用',
        'poor': '差',
        ', with limits': '，有所限制',
        '; expect blurred or wrong parts': '；会有模糊或错误的部分',
        'Next time:': '下一次：',
        'Also: {}': '另外：{0}',
        '# photo': '{0} 张照片',
        '# photos': '{0} 张照片',
        '# of # photos': '{1} 张照片中有 {0} 张',
        '… and # more, see {}.': '……还有 {0} 项，见 {1}。',
        '{} and # more': '{0} 和另外 {1} 张',
        'photo': '照片',
        'photos': '照片',
        'size': '尺寸',
        'Settings': '设置',
        'total time': '总时间',

        // The report of a training
        'Evaluated on {} of {} that were not used for training.': '在没有参加训练的 {0}（{1}）上评估。',
        'If there is time, make ends with a short training on all photos; all figures are those of the scene before.':
            '如果时间允许，make 最后会用所有照片再训练片刻；这里的数值都属于此前的场景。',
        'No photos were held out: these are the metrics of {} of {} used for training, which are better than those of new views.':
            '没有留出照片：这些是 {0}（{1}）的指标，它们参加了训练，所以指标好于新视角。',
        'Use --eval to hold out every 8th photo.': '用 --eval 可以每 8 张照片留出一张。',
        'PSNR, {} photos of {}': 'PSNR，{0}照片，{1}',
        'SSIM, {} photos of {}': 'SSIM，{0}照片，{1}',
        'colour-aligned PSNR, {} photos of {}': '颜色对齐的 PSNR，{0}照片，{1}',
        'held-out': '留出',
        'training': '训练',
        'Gaussians': '高斯',
        'steps': '步',
        'of training': '训练时间',
        'Photos that the scene does not explain': '场景不能解释的照片',
        'Left out of the training, because their camera poses are probably wrong: {}.':
            '没有参加训练，因为它们的相机位姿很可能是错的：{0}。',
        'What moves': '移动的东西',
        'In # of # photos, something looks different from what the other photos show at this place, for example a person who walks past.':
            '在 {1} 张照片中的 {0} 张里，有些部分与其他照片在同一处拍到的不同，例如有人走过。',
        'The tinted parts were not used for training.': '着色的部分没有用于训练。',
        '# more are in the folder masks.': '另外 {0} 张在文件夹 masks 中。',
        'The photos are off by # pixels in the median: the camera poses are not exact; try --refine-poses.':
            '照片偏差的中位数是 {0} 像素：相机位姿不准确；请试试 --refine-poses。',
        'The training': '训练',
        'Loss': '损失',
        'loss': '损失',
        'PSNR of the held-out photos, dB': '留出照片的 PSNR，dB',
        'Time of a step, ms': '每步的时间，ms',
        'time of a step, ms': '每步的时间，ms',
        'Exposures of the photos': '照片的曝光',
        'In EV (factors of two of light), relative to their mean, which is the exposure of the scene.':
            '以 EV 为单位（光量的倍数，以 2 为底），相对于平均值，即场景的曝光。',
        'training photo': '训练照片',
        'exposure, EV': '曝光，EV',
        'Photo, rendering, error': '照片、渲染图、误差',
        'Lowest PSNR': '最低的 PSNR',
        'Highest PSNR': '最高的 PSNR',
        'Photo, rendering, and error: the mean difference of red, green and blue, from black (0) to white (#% of the range, or more).':
            '照片、渲染图和误差：红、绿、蓝之差的平均值，从黑（0）到白（取值范围的 {0}% 或更多）。',
        'Each {} photo': '每张{0}照片',
        'evaluated': '评估的',
        'colour-aligned PSNR': '颜色对齐的 PSNR',
        'RMS error': '均方根误差',
        '# to train on, # held out': '{0} 张训练，{1} 张留出',
        'initial points': '初始点',
        'none': '无',
        'degree of the spherical harmonics': '球谐阶数',
        'All settings': '所有设置',
        'Machine': '机器',
        'trained on': '训练设备',
        'system': '系统',
        'memory': '内存',
        '# GB peak': '峰值 {0} GB',
        '# GB installed': '已安装 {0} GB',
        '# GB peak, # GB installed': '峰值 {0} GB，已安装 {1} GB',
        'Next': '接下来',

        // The verdict on a scene
        'the scene reproduces #% of the contrast of a typical held-out photo (# dB, colour-aligned, {})':
            '场景再现了典型留出照片 {0}% 的对比度（{1} dB，颜色对齐，{2}）',
        'the scene reproduces only #% of the contrast of a typical held-out photo (# dB, colour-aligned, {})':
            '场景只再现了典型留出照片 {0}% 的对比度（{1} dB，颜色对齐，{2}）',
        'the scene reproduces only #% of the contrast of a typical held-out photo (# dB, colour-aligned, {}); the error is # times that of the photos that it was trained on':
            '场景只再现了典型留出照片 {0}% 的对比度（{1} dB，颜色对齐，{2}）；误差是训练照片的 {3} 倍',
        'the scene reproduces only #% of the contrast of the photos that it was trained on (# dB)':
            '场景只再现了训练照片 {0}% 的对比度（{1} dB）',
        'train longer; if that does not help, check the camera poses in the report of the dataset':
            '延长训练；如果没有用，请检查数据集报告中的相机位姿',
        'the scene looks wrong in {}': '场景在这些照片中看上去不对：{0}',
        '{}; #% of what {} shows is in at most two training photos':
            '{0}；{2} 拍到的内容有 {1}% 最多只在两张训练照片中',
        'it': '它',
        'fine detail is blurred in held-out photos (SSIM #)': '留出照片中的精细细节是模糊的（SSIM {0}）',
        '# of # photos contradict the others and were left out: {}':
            '{1} 张照片中有 {0} 张与其他照片矛盾，没有使用：{2}',
        'the photos are off by # pixels in the median: the camera poses are not exact; try --refine-poses':
            '照片偏差的中位数是 {0} 像素：相机位姿不准确；请试试 --refine-poses',
        'the exposures of the photos differ by # EV, which the training corrects':
            '各张照片的曝光相差 {0} EV，训练会加以修正',
        'fix the exposure and the white balance of the camera': '固定相机的曝光和白平衡',
        'take more photos, closer together, also from the places of the worst held-out photos':
            '拍更多、更密的照片，也要从最差的留出照片的位置拍',

        // The verdict on photos
        '# of # photos could not be placed': '{1} 张照片中有 {0} 张无法求出位姿',
        '# of # photos could not be placed; the photos form # groups without common points':
            '{1} 张照片中有 {0} 张无法求出位姿；照片分成 {2} 组，组与组之间没有共同的点',
        'take more photos between those that are placed and those that are not':
            '在有位姿的照片和没有位姿的照片之间补拍一些照片',
        'the photos are far apart: the next one is typically #% of the distance to the scene away':
            '照片之间相距太远：到下一张的距离一般是到场景距离的 {0}%',
        'most photos have no other photo that shows the same': '大多数照片没有拍到相同内容的其他照片',
        'too few photos show the same: in a typical photo, #% of the points are in only one other photo':
            '拍到相同内容的照片太少：在一张典型的照片中，{0}% 的点只在另外一张照片中出现',
        'move by at most a tenth of the distance to what you photograph from one photo to the next, so that every place is in at least five photos':
            '每两张照片之间，移动的距离最多是到被摄物体距离的十分之一，使每个地方至少出现在五张照片中',
        '# photos are too few': '{0} 张照片太少',
        '# photos are few': '{0} 张照片偏少',
        'take 30 to 100 photos of an object or a room, and more of a larger place':
            '物体或房间拍 30 到 100 张照片，更大的地方拍得更多',
        'most of what {} shows, at the end of your path, is in only one other photo':
            '{0} 位于路径的一端，它拍到的内容大多只在另外一张照片中出现',
        'most of what {} and {} show, at the end of your path, is in only one other photo':
            '{0} 和 {1} 位于路径的两端，它们拍到的内容大多只在另外一张照片中出现',
        'begin earlier and end later than the place that you want to show':
            '从想展示的地方之前就开始拍，到它之后再结束',
        'the reprojection error is high: # pixels': '重投影误差较大：{0} 像素',
        'leave out photos that are blurred or show moving objects, or try another --camera':
            '去掉模糊的照片和拍到移动物体的照片，或者试试另一个 --camera',
        '# of # photos: each {}': '{1} 张照片中有 {0} 张：{2}',
        'all photos look in about the same direction: the scene can be seen from there only':
            '所有照片的朝向大致相同：只能从那里观看场景',
        '# photos; in a typical one, #% of the points are in at least two others':
            '{0} 张照片；在一张典型的照片中，{1}% 的点至少还出现在另外两张中',

        // The report of the dataset
        'The poses of all # photos were found.': '求出了全部 {0} 张照片的位姿。',
        'The poses of # of # photos were found.': '求出了 {1} 张照片中 {0} 张的位姿。',
        'The photos form # separate groups ({} photos); only the largest is used.':
            '照片分成互不相连的 {0} 组（{1} 张）；只使用最大的一组。',
        'Take more photos in between to connect them.': '请在各组之间补拍，把它们连接起来。',
        'photos with a pose': '有位姿的照片',
        'points, # observations': '个点，{0} 个观测',
        'mean reprojection error': '平均重投影误差',
        'lens': '个镜头',
        'lenses': '个镜头',
        'Your photos': '您的照片',
        'No photo is blurred, too dark or too bright.': '没有模糊、太暗或太亮的照片。',
        '{} may be better.': '{0}可以拍得更好。',
        'Take them again, or leave them out if others show the same.':
            '请重拍；如果其他照片拍到了相同的内容，也可以去掉它们。',
        '# photos were not used; the reasons are below.': '{0} 张照片没有使用，原因见下文。',
        'Fixed to the frame: {}.': '固定在画面上的部分：{0}。',
        'what is wrong': '问题',
        'is blurred': '模糊',
        'is too dark': '太暗',
        'is too bright: large parts are pure white': '太亮：大片是纯白色',
        'is blurred; hold the camera still, or take it in more light': '模糊；请拿稳相机，或者在更亮的地方拍',
        'is too dark; use more light, or a longer exposure': '太暗；请增加光线，或者延长曝光',
        'is too bright: large parts are pure white; use a shorter exposure': '太亮：大片是纯白色；请缩短曝光',
        'hold the camera still, or take it in more light': '拿稳相机，或者在更亮的地方拍',
        'use more light, or a longer exposure': '增加光线，或者延长曝光',
        'use a shorter exposure': '缩短曝光',
        '#% of the points are in at most three photos.': '{0}% 的点最多出现在三张照片中。',
        'There, the scene will look right only from the places of these photos.':
            '在那里，只有从这些照片的位置看，场景才是正确的。',
        'Take {} from the numbered places in the drawing from above:': '请在俯视图中编号的位置补拍{0}：',
        'a photo': '一张照片',
        '# more photos': ' {0} 张照片',
        '# to #': '{0} 到 {1}',
        'this part of the scene is in few photos': '场景的这一部分只有少数照片拍到',
        'no photo shows the subject from here (#° gap)': '没有照片从这里拍摄（空缺 {0}°）',
        'the next photos are far apart': '相邻的照片相距太远',
        'Cameras and points': '相机和点',
        'From above.': '俯视图。',
        'Orange: the cameras; white: the first camera.': '橙色：相机；白色：第一台相机。',
        'Numbers: places for more photos.': '数字：补拍照片的位置。',
        'Blue: the path of the video.': '蓝色：视频的路径。',
        'From the side.': '侧视图。',
        '# units': '{0} 个单位',
        'Level, north and scale': '水平、北方和比例',
        'level': '水平',
        'north': '北方',
        'metric': '比例',
        'note': '注意',
        'from {} and {}, to about #°': '由{0}和{1}求出，误差约 {2}°',
        'from {}, to about #°': '由{0}求出，误差约 {1}°',
        '+z is north, +x is east; from {}, to about #°': '+z 指北，+x 指东；由{0}求出，误差约 {1}°',
        '#° clockwise from +z, seen from above; from {}, to about #°': '从上方看，由 +z 顺时针 {0}°；由{1}求出，误差约 {2}°',
        '1 unit is # m, scale from {} (# m typical error), to about #%':
            '1 个单位等于 {0} m，由{1}求出（典型误差 {2} m），误差约 {3}%',
        'the ground': '地面',
        'the way the photos were held': '握持相机的方式',
        'GPS positions of # photos': ' {0} 张照片的 GPS 位置',
        'the {} of # photos': ' {1} 张照片的{0}',
        'gimbal angles': '云台角度',
        'accelerometers': '加速度计',
        'compasses': '罗盘',
        'Images': '图像',
        'Lenses': '镜头',
        'focal length (longer side)': '焦距（较长边的视场角）',
        'lens model': '镜头模型',
        '# px (#°), {}': '{0} px（{1}°），{2}',
        'all directions': '所有方向',
        'from EXIF, refined': '取自 EXIF，经过优化',
        'from EXIF; the photos do not determine it': '取自 EXIF；照片不能确定它',
        'estimated from the photos': '由照片估计',
        'a usual one; the photos do not determine it': '常见的值；照片不能确定它',
        'Images for training: {}, {}.': '训练所用的图像：{0}，{1}。',
        'undistorted': '已去畸变',
        'copied, as there is no distortion': '直接复制，因为没有畸变',
        'Photos not used': '没有使用的照片',
        'reason': '原因',
        'it is in a separate group of # photos': '它属于另外一组 {0} 张照片',
        'it shows hardly any detail (# features): too dark, blurred or plain':
            '几乎没有细节（{0} 个特征）：太暗、模糊或者是单色的',
        'it matches no other photo': '它与其他照片都不匹配',
        'it has too few matches with {} (at most #)': '它与{0}的匹配太少（最多 {1} 个）',
        'its matches with {} are not consistent with the model': '它与{0}的匹配和模型不一致',
        '# other photo': '另外 {0} 张照片',
        '# other photos': '另外 {0} 张照片',
        'is completely black': '全黑',
        'is completely white': '全白',
        'is completely of one colour': '只有一种颜色',
        'is too blurred': '太模糊',
        'shows the same view as the previous frame': '与前一帧的画面相同',
        'Time and settings': '时间和设置',
        'Inputs: {}.': '输入：{0}。',
        'Matched pairs: {}.': '匹配的照片对：{0}。',
        'stage': '阶段',
        'time': '时间',
        'reading photos': '读取照片',
        'estimating poses': '估计位姿',
        'undistorting': '去畸变',
        'Next step': '下一步',

        // The page of an image, and that of benchmarks
        '# × # pixels, approximated by # 2D Gaussians.': '{0} × {1} 像素，由 {2} 个二维高斯近似。',
        'Gaussians, front-to-back': '高斯，从前到后混合',
        'Gaussians, additive': '高斯，加性混合',
        'for # steps': '{0} 步的时间',
        'bits per pixel: # bytes, # dB': '每像素的比特数：{0} 字节，{1} dB',
        'The photo': '照片',
        'The Gaussians': '高斯',
        'The Gaussians at half their size': '一半大小的高斯',
        'The fit; the video becomes faster towards the end': '拟合的过程；视频越到后面越快',
        'The fit': '拟合',
        'seconds': '秒',
        'Files': '文件',
        'the image that the Gaussians approximate the photo with': '高斯近似照片所得的图像',
        'the Gaussians, quantised: a compact file': '量化后的高斯：紧凑的文件',
        'an ellipse with a gradient for each Gaussian': '每个高斯是一个带渐变的椭圆',
        'a video of the fit': '拟合过程的视频',
        'PSNR and SSIM, and their course': 'PSNR 和 SSIM，以及它们的变化',
        'this page': '本页',
        'processor': '处理器',
        'scene': '场景',
        'published PSNR': '公布的 PSNR',
        'memory GB': '内存 GB',
        'The view with the lowest PSNR of each scene: photo, rendering': '每个场景中 PSNR 最低的视图：照片、渲染图',
        '{}; # training photos, # test photos': '{0}；{1} 张训练照片，{2} 张测试照片',
    };
    const parts = { '#': '([0-9.,]+)', '{}': '(.+?)' };
    const rules = [];
    const learn = (texts) => {
        Object.assign(TEXTS, texts);
        for (const [english, chinese] of Object.entries(texts)) {
            const pattern = english.replace(/\{\}|[#.*+?^$()|[\]\\]/g, (found) => parts[found] ?? '\\' + found);
            rules.push([new RegExp(`^${pattern}$`, 'i'), chinese]);
        }
    };
    learn({ ...TEXTS });
    // A clause may begin with a capital letter; a text of the table in this spelling has priority.
    const translated = (text) => {
        if (Object.hasOwn(TEXTS, text)) return TEXTS[text];
        for (const [rule, chinese] of rules) {
            const found = rule.exec(text);
            if (found) return chinese.replace(/\{(\d)\}/g, (_, part) => translated(found[1 + Number(part)]));
        }
        return text;
    };
    const inChinese = (text) => text.replace(/(e\.g)?\. (?=[A-Z])/g, (end, example) => (example ? end : '. \n')).split('\n').map((sentence) => {
        const chinese = translated(sentence.trim());
        return chinese === sentence.trim() ? sentence : chinese;
    }).join('');
    return Object.assign(inChinese, { learn });
})();
